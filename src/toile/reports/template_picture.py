"""A picture to judge a template by, before anything is fitted."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from toile.geometry.surface import Floats
from toile.preparation.template_making.making import MadeTemplate, corner_vertices
from toile.reports.figures import STYLE
from toile.reports.palette import GROUND_TRUTH, INK, MUTED, RECONSTRUCTION, SERIES

_MARGIN = 0.15  # of the cloth's size in the image, shown around it
_AXES = ("axis 0, along the upper side", "axis 1, downwards")


def template_picture(made: MadeTemplate) -> Figure:
    """Grid over frame 0 with names of its corners and pinned vertices, side view, edge lengths, shear."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(12.4, 7.4), layout="constrained")
        FigureCanvasAgg(figure)
        grid = figure.add_gridspec(2, 3, width_ratios=(2.1, 1, 1))
        _over_frame(figure.add_subplot(grid[:, 0]), made)
        _view(figure.add_subplot(grid[0, 1]), made, 2, "from the side", "depth z [m]")
        _view(figure.add_subplot(grid[0, 2]), made, 0, "as the camera sees it", "x [m]")
        _edges(figure.add_subplot(grid[1, 1]), made)
        _shear(figure.add_subplot(grid[1, 2]), made)
    return figure


def _over_frame(axis: Axes, made: MadeTemplate) -> None:
    scene = made.scene
    pixels = scene.camera.project(scene.template).numpy()
    h, w = scene.frames.shape[1:3]
    axis.imshow(scene.frames[0].numpy(), extent=(0, w, h, 0))
    axis.contour(np.arange(w) + 0.5, np.arange(h) + 0.5, scene.masks[0].numpy(), [0.5], colors=GROUND_TRUTH)
    for lines in (pixels, pixels.transpose(1, 0, 2)):
        for line in lines:
            axis.plot(*line.T, color="white", linewidth=0.5, alpha=0.8)
    flat = pixels.reshape(-1, 2)
    middle = flat.mean(0)
    for name, k in corner_vertices(scene.grid).items():
        i, j = divmod(k, scene.grid[1])
        _label(axis, flat[k], middle, f"{name} [{i}, {j}]")
    pinned = flat[list(scene.pinned_vertices)]
    axis.plot(*pinned.T, "o", markersize=9, markerfacecolor="none", markeredgewidth=2, color=SERIES[4])
    lower, upper = flat.min(0), flat.max(0)
    margin = _MARGIN * float((upper - lower).max())
    axis.set_xlim(max(lower[0] - margin, 0), min(upper[0] + margin, w))
    axis.set_ylim(min(upper[1] + margin, h), max(lower[1] - margin, 0))
    axis.grid(False)
    axis.set_title(f"{scene.name}, frame 0: grid, mask (orange), pinned vertices (circles)")
    axis.set_title(f"IoU {made.iou:.3f}", loc="right", color=MUTED)


def _label(axis: Axes, at: Sequence[float], middle: Sequence[float], text: str) -> None:
    """Write beside a corner, towards the outside in height and the inside in width."""
    up, left = at[1] < middle[1], at[0] < middle[0]
    axis.annotate(
        text,
        (at[0], at[1]),
        xytext=(-12 if left else 12, 12 if up else -12),
        textcoords="offset points",
        ha="left" if left else "right",
        va="bottom" if up else "top",
        fontsize=8,
        color=INK,
        bbox={"boxstyle": "round,pad=0.2", "facecolor": "white", "edgecolor": "none", "alpha": 0.85},
    )


def _view(axis: Axes, made: MadeTemplate, coordinate: int, title: str, label: str) -> None:
    p = made.scene.template.numpy()
    x, height = p[..., coordinate], -p[..., 1]
    for u, v in ((x, height), (x.T, height.T)):
        axis.plot(u, v, color=RECONSTRUCTION, linewidth=0.4, alpha=0.7)
    pinned = list(made.scene.pinned_vertices)
    axis.plot(x.ravel()[pinned], height.ravel()[pinned], "o", color=SERIES[4], markersize=5)
    axis.set_aspect("equal")
    # A flat cloth seen from the side is too narrow for its own axis.
    middle, half = (x.max() + x.min()) / 2, max(np.ptp(x) / 2, 0.25 * np.ptp(height))
    axis.set_xlim(middle - 1.05 * half, middle + 1.05 * half)
    axis.locator_params(axis="x", nbins=4)
    axis.set_title(title)
    axis.set_xlabel(label)
    axis.set_ylabel("height −y [m]")


def _edges(axis: Axes, made: MadeTemplate) -> None:
    for lengths, rest, name, colour in zip(made.edges, _rest(made), _AXES, SERIES, strict=False):
        label = f"{name}: {1e3 * lengths.mean():.2f} mm ± {100 * lengths.std() / lengths.mean():.1f} %"
        axis.hist(
            1e3 * lengths,
            bins=40,
            range=_range(1e3 * lengths, 0.01 * 1e3 * lengths.mean()),
            color=colour,
            alpha=0.6,
            label=label,
        )
        axis.axvline(1e3 * rest, color=colour, linestyle=(0, (4, 3)), linewidth=1)
    axis.set_title("edge lengths (dashed: cloth size)")
    axis.set_xlabel("mm")
    axis.set_ylabel("edges")
    _legend_above(axis)


def _range(values: Floats, least: float) -> tuple[float, float]:
    """From the smallest to the largest value, not narrower than ``least`` to both sides of the mean."""
    mean = float(values.mean())
    return min(float(values.min()), mean - least), max(float(values.max()), mean + least)


def _rest(made: MadeTemplate) -> tuple[float, float]:
    (H, W), size = made.scene.grid, made.scene.cloth_size
    return size[0] / (H - 1), size[1] / (W - 1)


def _shear(axis: Axes, made: MadeTemplate) -> None:
    axis.hist(made.shear, bins=40, range=_range(made.shear, 1.0), color=SERIES[2], alpha=0.8)
    axis.set_title("angles of the cells minus 90°")
    axis.set_xlabel("degrees")
    axis.set_ylabel("corners")


def _legend_above(axis: Axes) -> None:
    """A legend that covers no bar."""
    axis.set_ylim(top=1.3 * axis.get_ylim()[1])
    axis.legend(fontsize=7, loc="upper left", frameon=True, framealpha=1, edgecolor="none", borderpad=0)
