"""How far a predicted cloth is from where the images have it.

The tracked motion is no judge of predictions: where images leave room, it has been refined by the base model,
so that what the base model predicts is near it, right or wrong. The images' own quadratic knows nothing of
that model. Its lowest point is where images alone would have the cloth, and its matrix says in which
directions they know; what they do not see, such as depth, hardly counts.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from toile.diagnosis.image_information import as_array
from toile.diagnosis.tracked import Tracked

Array = NDArray[np.float64]

METRIC = "distance to where the images have the cloth [mm]"

_PRIOR = 0.01
"""Information that the tracked positions have of themselves, over that of the best seen vertex."""


class ImageError:
    """Distances to where images alone have the cloth.

    Args:
        tracked: what images say, softened by the model's error: so every direction counts alike that they see
            better than the model can be right.
    """

    def __init__(self, tracked: Tracked) -> None:
        self._tracked = tracked
        self._favoured: dict[int, Array] = {}
        self._known: dict[int, float] = {}

    def favoured(self, frame: int) -> Array:
        """Where images alone have the cloth (N, 3) [m]: the lowest point of their quadratic.

        Directions that they know nothing of stay as tracked.
        """
        if frame not in self._favoured:
            matrix = np.asarray(as_array(self._tracked.information[frame]), np.float64)
            self._known[frame] = float(matrix.diagonal().sum())
            known = matrix + _PRIOR * matrix.diagonal().max() * np.eye(len(matrix))
            slope = self._tracked.gradient[frame].reshape(-1)
            moved = cho_solve(cho_factor(known, lower=True), slope)
            self._favoured[frame] = self._tracked.positions[frame] - moved.reshape(-1, 3)
        return self._favoured[frame]

    def of(self, frame: int, x: Array) -> float:
        """Root mean square distance [m] of positions x (N, 3) in a frame, directions weighed as seen."""
        matrix = self._tracked.information[frame]
        away = (x - self.favoured(frame)).reshape(-1)
        return float(np.sqrt(3 * away @ (matrix @ away) / self._known[frame]))
