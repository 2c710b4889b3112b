"""Static figures of a run (matplotlib, no display needed)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, NullLocator, StrMethodFormatter

from toile.atomic_file import written_atomically
from toile.errors import InputError
from toile.evaluation.evaluate import EvaluationResult
from toile.reports.palette import GROUND_TRUTH, INK, MUTED, RECONSTRUCTION, RULE, SERIES

STYLE: Any = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.titlelocation": "left",
    "axes.edgecolor": MUTED,
    "axes.labelcolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": RULE,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "text.color": INK,
    "lines.linewidth": 1.6,
    "legend.frameon": False,
    "figure.facecolor": "white",
}
CYCLE = "cycle"
"""Column of a history that counts optimisation cycles; the row number stands in where it is missing."""
MAX_POINTS = 1500
"""Ground-truth points drawn per side view."""


def error_over_frames(result: EvaluationResult, keys: Sequence[str] | None = None) -> Figure:
    """One panel per metric over the frames, with its mean.

    Args:
        result: what ``evaluate`` returned.
        keys: metrics to draw, default all that have a value.

    Raises:
        InputError: no such metric, or none at all.
    """
    chosen = [k for k, m in result.metrics.items() if np.isfinite(m.mean)] if keys is None else list(keys)
    unknown = [k for k in chosen if k not in result.metrics]
    if unknown or not chosen:
        raise _nothing(
            "errors over frames", ", ".join(result.metrics) or "a metric", ", ".join(unknown) or "none"
        )
    figure, axes = _panels(len(chosen))
    for axis, key, colour in zip(axes, chosen, _colours(len(chosen)), strict=True):
        metric = result.metrics[key]
        axis.plot(np.arange(result.n_frames), metric.per_frame, color=colour, marker="o", markersize=2.5)
        axis.axhline(metric.mean, color=colour, linewidth=0.9, linestyle=(0, (4, 3)))
        unit = f" {metric.unit}" if metric.unit else ""
        _label(axis, metric.title, f"mean {metric.mean:.3g}{unit}", metric.unit, "frame")
        if key == "silhouette_iou":
            axis.set_ylim(top=1.0)
        elif not metric.higher_is_better:
            axis.set_ylim(bottom=0.0)
        axis.margins(x=0.02)
    return figure


def parameter_histories(history: pd.DataFrame, units: Mapping[str, str]) -> Figure:
    """One panel per fitted parameter over the optimisation cycles.

    Args:
        history: one row per cycle.
        units: columns to draw, each with its unit ("" where it has none).

    Raises:
        InputError: a column is missing, or there is nothing to draw.
    """
    _require(history, list(units), "parameter histories")
    figure, axes = _panels(len(units))
    for axis, (name, unit), colour in zip(axes, units.items(), _colours(len(units)), strict=True):
        values = history[name].to_numpy(dtype=float)
        axis.plot(_cycles(history), values, color=colour)
        _label(axis, name, f"last {values[-1]:.4g} {unit}".rstrip(), unit, "cycle")
    return figure


def loss_curves(history: pd.DataFrame, columns: Sequence[str] | None = None) -> Figure:
    """Losses over the optimisation cycles on a logarithmic axis.

    Args:
        history: one row per cycle.
        columns: columns to draw, default all whose name begins with "loss".

    Raises:
        InputError: a column is missing, or there is nothing to draw.
    """
    chosen = [c for c in history.columns if str(c).startswith("loss")] if columns is None else list(columns)
    _require(history, chosen, "loss curves")
    with mpl.rc_context(STYLE):
        figure = _figure(6.4, 3.4)
        axis = figure.add_subplot()
        for name, colour in zip(chosen, _colours(len(chosen)), strict=True):
            values = history[name].to_numpy(dtype=float)
            # A term that is switched off is zero, which a logarithmic axis cannot show.
            axis.plot(_cycles(history), np.where(values > 0, values, np.nan), color=colour, label=name)
        axis.set_yscale("log")
        axis.set_xlabel("cycle")
        axis.set_ylabel("loss")
        axis.legend(fontsize=8)
    return figure


def side_view(
    positions: npt.NDArray[np.floating],
    frames: Sequence[int],
    ground_truth: Sequence[npt.NDArray[np.floating]] | None = None,
) -> Figure:
    """The cloth seen from the side (depth against height) at a few frames, over the ground-truth points.

    The side view shows what the camera cannot: an error in depth.

    Args:
        positions: trajectory (F, H, W, 3) [m], camera frame.
        frames: frames to draw.
        ground_truth: ground-truth points (N_f, 3) [m] for every frame, or None.

    Raises:
        InputError: a frame outside the trajectory, or none.
    """
    if not frames or min(frames) < 0 or max(frames) >= len(positions):
        raise _nothing("side view", f"frames from 0 to {len(positions) - 1}", str(list(frames)))
    with mpl.rc_context(STYLE):
        figure = _figure(2.1 * len(frames) + 0.6, 3.6)
        axes = figure.subplots(1, len(frames), sharex=True, sharey=True, squeeze=False)[0]
        for axis, f in zip(axes, frames, strict=True):
            depth, height = positions[f, ..., 2], -positions[f, ..., 1]
            if ground_truth is not None:
                points = ground_truth[f][:: max(1, len(ground_truth[f]) // MAX_POINTS)]
                axis.scatter(
                    points[:, 2], -points[:, 1], s=1.2, color=GROUND_TRUTH, alpha=0.6, linewidths=0, zorder=3
                )
            axis.plot(depth, height, color=RECONSTRUCTION, linewidth=0.4, alpha=0.7)
            axis.plot(depth.T, height.T, color=RECONSTRUCTION, linewidth=0.4, alpha=0.7)
            axis.set_title(f"frame {f}")
            axis.set_aspect("equal")
            axis.set_xlabel("depth z [m]")
        axes[0].set_ylabel("height −y [m]")
        axes[0].plot([], [], color=RECONSTRUCTION, label="reconstruction")
        if ground_truth is not None:
            axes[0].scatter([], [], s=8, color=GROUND_TRUTH, label="ground truth")
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=8)
    return figure


def stability_curves(
    curves: Mapping[str, tuple[npt.NDArray[np.floating], npt.NDArray[np.floating]]], title: str
) -> Figure:
    """Chamfer distance of fits that run longer than usual, as in the paper's Figure 8, on logarithmic axes.

    Args:
        curves: by label, lengths (n,) in units of the usual one and Chamfer distances (n,) [1e-4 m²].
        title: of the figure.

    Raises:
        InputError: no curve.
    """
    if not curves:
        raise _nothing("stability", "at least one curve", "none")
    with mpl.rc_context(STYLE):
        figure = _figure(7.2, 3.6)
        axis = figure.add_subplot()
        for (label, (lengths, distances)), colour in zip(curves.items(), _colours(len(curves)), strict=True):
            axis.plot(lengths, distances, color=colour, label=label)
        axis.axvline(1, color=INK, linewidth=0.9, linestyle=(0, (4, 3)))
        axis.set_xscale("log")
        axis.set_yscale("log")
        ticks = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 40]
        axis.set_xticks(ticks, ["usual length" if t == 1 else f"{t:g}×" for t in ticks])
        axis.xaxis.set_minor_locator(NullLocator())
        axis.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axis.yaxis.set_minor_formatter(NullFormatter())
        axis.set_xlabel("cycles, in units of the usual length")
        axis.set_ylabel("Chamfer ×10⁴ [m²]")
        axis.set_title(title)
        axis.legend(fontsize=8)
    return figure


def save_figure(figure: Figure, path: Path, dpi: int = 160) -> Path:
    """Write a figure (PNG, SVG or PDF by suffix) atomically; returns ``path``."""
    with written_atomically(path) as temporary:
        figure.savefig(temporary, dpi=dpi)
    return path


def _figure(width: float, height: float) -> Figure:
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _panels(n: int) -> tuple[Figure, list[Axes]]:
    """Figure with n panels, up to three side by side."""
    columns = min(n, 3)
    rows = -(-n // columns)
    with mpl.rc_context(STYLE):
        figure = _figure(3.6 * columns, 2.2 * rows)
        axes = list(figure.subplots(rows, columns, squeeze=False).flat)
    for axis in axes[n:]:
        axis.remove()
    return figure, axes[:n]


def _label(axis: Axes, title: str, note: str, unit: str, x: str) -> None:
    axis.set_title(title, loc="left", fontsize=9)
    axis.set_title(note, loc="right", fontsize=8, color=MUTED)
    axis.set_ylabel(unit or "–")
    axis.set_xlabel(x)


def _colours(n: int) -> list[str]:
    return [SERIES[k % len(SERIES)] for k in range(n)]


def _cycles(history: pd.DataFrame) -> npt.NDArray[np.float64]:
    return history[CYCLE].to_numpy(dtype=float) if CYCLE in history else np.arange(len(history), dtype=float)


def _require(history: pd.DataFrame, columns: list[str], what: str) -> None:
    missing = [c for c in columns if c not in history]
    if missing or not columns or history.empty:
        have = ", ".join(map(str, history.columns)) or "columns"
        raise _nothing(what, f"at least one row and some of: {have}", ", ".join(missing) or "nothing to draw")


def _nothing(what: str, expected: str, got: str) -> InputError:
    return InputError("The figure cannot be drawn", where=what, expected=expected, got=got)
