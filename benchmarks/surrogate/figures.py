"""The card's pictures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from surrogate.accuracy import MOTION
from surrogate.contenders import EXTRAPOLATION, FLOOR, SOLVER, WITHOUT_NETWORK
from surrogate.tables import WANTED
from toile.atomic_file import written_atomically
from toile.reports.figures import STYLE
from toile.reports.palette import INK, MUTED, SERIES

_COLOURS = (*SERIES, INK)
_SMALLEST = 1e-3
"""Vertex error [% of width] below which nothing is told apart."""


def save(figure: Figure, path: Path) -> None:
    """As PNG."""
    FigureCanvasAgg(figure)
    with written_atomically(path) as temporary:
        figure.savefig(temporary, dpi=150)


def error_distributions(tables: dict[str, pd.DataFrame]) -> Figure:
    """Share of the cloths over the vertex error that they do not exceed, one panel per regime."""
    found = dict.fromkeys(n for t in tables.values() for n in t.contender if n not in (SOLVER, FLOOR))
    names = [*found, FLOOR]
    with mpl.rc_context(STYLE):
        figure = _figure(3.1 * len(tables) + 1.2, 3.6)
        axes = figure.subplots(1, len(tables), sharey=True, squeeze=False)[0]
        for axis, (regime, table) in zip(axes, tables.items(), strict=True):
            for place, name in enumerate(names):
                errors = table[table.contender == name][MOTION].to_numpy(dtype=float)
                if not len(errors):
                    continue
                shown = np.sort(errors[np.isfinite(errors)]).clip(min=_SMALLEST)
                share = np.arange(len(shown) + 1) / len(errors)
                axis.step(
                    np.concatenate(([_SMALLEST], shown)),
                    share,
                    where="post",
                    label=name,
                    color=MUTED if name == FLOOR else _COLOURS[place % len(_COLOURS)],
                    linestyle=_style(name),
                )
            for wanted, limit in WANTED.items():
                axis.plot([limit], [wanted], marker="x", color=MUTED, linestyle="none")
            axis.set_xscale("log")
            axis.set_xlim(_SMALLEST, 100)
            axis.set_ylim(0, 1)
            axis.set_title(regime)
            axis.set_xlabel(MOTION)
        axes[0].set_ylabel("share of the cloths")
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=7)
    return figure


def error_by_number(table: pd.DataFrame, shown: Sequence[str]) -> Figure:
    """Vertex error of every cloth over its stiffnesses and gravity."""
    with mpl.rc_context(STYLE):
        figure = _figure(10.5, 3.4)
        axes = figure.subplots(1, 4, sharey=True)
        for axis, name in zip(axes, ("Y", "S", "B", "gravity"), strict=True):
            for place, contender in enumerate(shown):
                part = table[table.contender == contender]
                axis.plot(
                    part[name],
                    part[MOTION].clip(lower=_SMALLEST),
                    marker="o",
                    markersize=2.5,
                    linestyle="none",
                    color=SERIES[place],
                    label=contender,
                )
            axis.set_xscale("log")
            axis.set_yscale("log")
            axis.set_xlabel(f"{name} [network units]")
            for limit in WANTED.values():
                axis.axhline(limit, color=MUTED, linewidth=0.8, linestyle=(0, (4, 3)))
        axes[0].set_ylabel(MOTION)
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(shown), fontsize=7)
    return figure


def energies(table: pd.DataFrame) -> Figure:
    """Energy of every material over the steps, one panel per contender."""
    names = list(dict.fromkeys(table.contender))
    levels = sorted(table.Y.unique())
    with mpl.rc_context(STYLE):
        figure = _figure(3.3 * len(names) + 0.8, 3.2)
        axes = figure.subplots(1, len(names), sharey=True, squeeze=False)[0]
        for axis, name in zip(axes, names, strict=True):
            for (y, _, _), motion in table[table.contender == name].groupby(["Y", "S", "B"]):
                axis.plot(
                    motion.step.clip(lower=1), motion.energy, linewidth=0.8, color=SERIES[levels.index(y)]
                )
            axis.axhline(0, color=MUTED, linewidth=0.8)
            axis.set_xscale("log")
            axis.set_title(name)
            axis.set_xlabel("step")
        axes[0].set_ylabel("energy above start / (weight × side)")
        for place, y in enumerate(levels):
            axes[-1].plot([], [], color=SERIES[place], label=f"Y = {y:.3g}")
        axes[-1].legend(fontsize=7)
    return figure


def _style(contender: str) -> Any:
    """Lines of matplotlib: whole with the network, broken without."""
    dashed = dict.fromkeys(WITHOUT_NETWORK, (5, 2))
    broken = dashed | {EXTRAPOLATION: (5, 1.5, 1, 1.5), FLOOR: (1, 1.5)}
    return (0, broken[contender]) if contender in broken else "-"


def _figure(width: float, height: float) -> Figure:
    return Figure(figsize=(width, height), layout="constrained")
