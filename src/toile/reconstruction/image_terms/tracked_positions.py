"""Positions that an earlier stage has tracked, as data: a term without false minima.

Images are a poor guide for a motion that is still far off: repeated texture has false minima. Positions are a
smooth one. Fitting stiffness and wind to a tracked motion first, and to the images afterwards, converges from
start values that are wrong by large factors.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from toile.limits import Positive, Unit
from toile.reconstruction.image_terms.texture_points import PointTermValue

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PositionTermSettings:
    """Settings of the term.

    Attributes:
        deviation: standard deviation of a tracked coordinate, averaged over the vertices [m].
    """

    deviation: Annotated[Positive, Unit("m")]


class TrackedPositionTerm:
    """½ Σ |x - x_tracked|² / (σ² N) per frame.

    Args:
        tracked: (F, N, 3) [m].
        settings: see PositionTermSettings.
    """

    def __init__(self, tracked: Array, settings: PositionTermSettings) -> None:
        self._tracked = tracked.copy()
        self._weight = 1 / (settings.deviation**2 * tracked.shape[1])

    def evaluate(
        self, x: Array, first_frame: int, visible: NDArray[np.float32] | None, *, derivatives: bool
    ) -> PointTermValue:
        """See TexturePointTerm.evaluate; all vertices count, visible or not."""
        away = x - self._tracked[first_frame : first_frame + len(x)]
        cost = 0.5 * self._weight * (away**2).sum((1, 2))
        return PointTermValue(cost, np.zeros(len(x)), self._weight * away, np.empty(0))

    def apply(self, value: PointTermValue, change: Array) -> Array:
        """See TexturePointTerm.apply."""
        return self._weight * change
