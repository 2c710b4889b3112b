"""Pictures of a training run: cloths of the pool, and the curve of the validation rollout."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch import Tensor

_VIEWS = ((0, 1), (0, 2), (1, 2))
_COLOUR = "#0f62ac"


def pool_picture(positions: Tensor, titles: list[str]) -> Figure:
    """Cloths seen along the three axes, one row for each.

    Args:
        positions: (n, H, W, 3).
        titles: one for each cloth.
    """
    x = positions.detach().cpu().numpy()
    figure = Figure(figsize=(6.6, 2.2 * len(x)), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(x), len(_VIEWS), squeeze=False)
    for cloth, title, row in zip(x, titles, axes, strict=True):
        for (a, b), axis in zip(_VIEWS, row, strict=True):
            axis.plot(cloth[..., a], cloth[..., b], color=_COLOUR, linewidth=0.4)
            axis.plot(cloth[..., a].T, cloth[..., b].T, color=_COLOUR, linewidth=0.4)
            axis.set_aspect("equal", adjustable="datalim")
            axis.set_xlabel("xyz"[a], fontsize=7)
            axis.set_ylabel("xyz"[b], fontsize=7)
            axis.tick_params(labelsize=6)
        row[0].set_title(title, loc="left", fontsize=8)
    return figure


def residual_curve(residual: Tensor) -> Figure:
    """Out-of-balance force over the steps of a rollout: every cloth, and their median.

    Args:
        residual: relative, (steps, cloths).
    """
    curves = residual.detach().cpu().double().numpy()
    curves = np.where(np.isfinite(curves) & (curves > 0), curves, np.nan)
    figure = Figure(figsize=(5.0, 3.0), layout="constrained")
    FigureCanvasAgg(figure)
    axis = figure.add_subplot()
    steps = np.arange(1, len(curves) + 1)
    axis.plot(steps, curves, color=_COLOUR, linewidth=0.6, alpha=0.4)
    axis.plot(
        steps, residual.nanmedian(1).values.cpu().numpy(), color="#1c2430", linewidth=1.6, label="median"
    )
    axis.set_yscale("log")
    axis.set_xlabel("step")
    axis.set_ylabel("mean out-of-balance force / mean external force")
    axis.legend(frameon=False)
    axis.grid(alpha=0.3)
    return figure


def pixels(figure: Figure, dpi: int = 110) -> npt.NDArray[np.uint8]:
    """The drawn figure, (h, w, 3) uint8."""
    figure.set_dpi(dpi)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
