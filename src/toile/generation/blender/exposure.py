"""From Blender's linear images to frames and masks: lens, noise, 8 bits, biased masks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, map_coordinates

from toile.generation.blender.settings import BlenderSettings

Array = NDArray[np.float64]


def expose(
    settings: BlenderSettings, image: Array, rng: np.random.Generator
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """One frame and its mask.

    Args:
        settings: of the scene.
        image: (h, w, 4), linear light, multiplied by coverage.
        rng: of the noise.

    Returns:
        Frame (h, w, 3) in [0, 1], rounded to 8 bits, black outside the mask; mask (h, w) of 0 and 1.
    """
    values = settings.values
    if settings.effect == "lens_distortion":
        image = distorted(image, settings.focal_length, values["k1"])
    mask = grown(image[..., 3] > 0.5, values.get("pixels", 0.0))
    frame = srgb(image[..., :3]) + settings.noise * rng.standard_normal((*mask.shape, 3))
    covered = image[..., 3] > 0
    frame = (frame.clip(0, 1) * 255).round() / 255 * (mask & covered)[..., None]
    return frame.astype(np.float32), mask.astype(np.float32)


def srgb(linear: Array) -> Array:
    """Encode linear light in [0, 1] for the screen (IEC 61966-2-1)."""
    linear = linear.clip(0, 1)
    encoded: Array = np.where(
        linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055
    )
    return encoded


def distorted(image: Array, focal_length: float, k1: float) -> Array:
    """An image (h, w, C) as a lens would show it that moves points at r to r (1 + k1 r²).

    r is the distance from the middle of the image in focal lengths; interpolated linearly.
    """
    height, width = image.shape[:2]
    rows, columns = np.mgrid[:height, :width] + 0.5
    seen = np.stack((rows - height / 2, columns - width / 2)) / focal_length
    straight = seen.copy()
    for _ in range(30):
        straight = seen / (1 + k1 * (straight**2).sum(0))
    at = straight * focal_length + np.array([height / 2, width / 2])[:, None, None] - 0.5
    return np.stack([map_coordinates(channel, at, order=1) for channel in np.moveaxis(image, -1, 0)], axis=-1)


def grown(mask: NDArray[np.bool_], pixels: float) -> NDArray[np.bool_]:
    """A mask (h, w) grown by a distance, shrunk if it is negative [px]."""
    if pixels == 0:
        return mask
    distance: Array = distance_transform_edt(~mask if pixels > 0 else mask)
    # Distances are to the middles of pixels, half a pixel beyond the edge.
    return distance - 0.5 <= pixels if pixels > 0 else distance - 0.5 >= -pixels
