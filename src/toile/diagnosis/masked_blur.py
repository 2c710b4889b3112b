"""Colours of a cloth at points in an image, blurred without what is beside the cloth."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates

Array = NDArray[np.float64]


def blurred_at(image: Array, mask: Array, pixels: Array, blur: float) -> tuple[Array, Array]:
    """Values of an image at points, and how much of the blur around each is cloth.

    Args:
        image: one channel (H, W).
        mask: of the cloth, 0 to 1 (H, W).
        pixels: x and y of the points, pixel centres at halves (P, 2) [px].
        blur: σ [px].

    Returns:
        Values (P,), and shares of the cloth within the blur (P,).
    """
    where = [pixels[:, 1] - 0.5, pixels[:, 0] - 0.5]
    share = gaussian_filter(mask, blur)
    values = gaussian_filter(image * mask, blur) / np.maximum(share, 1e-3)
    found, inside = (map_coordinates(of, where, order=1, mode="nearest") for of in (values, share))
    return found, inside
