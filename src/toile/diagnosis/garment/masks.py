"""Masks of person and garment, and the form in which observed and simulated ones are compared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from torch import Tensor

from toile.capture.losses.silhouette import distance_field
from toile.errors import InputError
from toile.geometry.camera import Camera
from toile.limits import Count
from toile.rendering import WarpRenderer

Floats = NDArray[np.float64]


class MaskRenderer:
    """Draws the masks of a garment on a body.

    Args:
        body_faces: (Tb, 3) of V vertices.
        garment_faces: (Tg, 3).
        n_body: V.
    """

    def __init__(self, body_faces: Tensor, garment_faces: Tensor, n_body: int) -> None:
        self._faces = torch.cat((body_faces, garment_faces + n_body))
        self._renderer = WarpRenderer(2)
        # A white garment on a black body: its mask, where the body does not hide it.
        self._texture = torch.zeros(1, 10, 3)
        self._texture[:, 5:] = 1.0

    def __call__(
        self, garment: Tensor, bodies: Tensor, cameras: Sequence[Camera], bias: float = 0.0
    ) -> Floats:
        """Antialiased masks of person and garment.

        Args:
            garment: (F, N, 3) [m].
            bodies: (F, V, 3) [m].
            cameras: C of them.
            bias: of the outlines, outwards [px].

        Returns:
            (C, 2, F, h, w) in [0, 1].
        """
        both = torch.cat((bodies, garment), 1)
        uv = torch.full((both.shape[1], 2), 0.5)
        uv[:, 0] = 0.1
        uv[bodies.shape[1] :, 0] = 0.9
        found = []
        for camera in cameras:
            drawn = self._renderer.render(both, self._faces, uv, self._texture, camera)
            found.append([shifted(drawn.silhouette, bias), shifted(drawn.rgb[..., 0], bias)])
        return np.stack([np.stack([mask.double().numpy() for mask in pair]) for pair in found])


def shifted(masks: Tensor, bias: float) -> Tensor:
    """Masks (F, h, w) whose outlines are moved outwards [px]."""
    if not bias:
        return masks
    moved = []
    for mask in masks:
        distance = distance_field(mask > 0.5)
        # Antialiased outlines stay so: the change alone is taken from the distances.
        change = (0.5 - (distance - bias)).clamp(0, 1) - (0.5 - distance).clamp(0, 1)
        moved.append(mask + change.to(mask))
    return torch.stack(moved)


@dataclass(frozen=True)
class SmoothedAreas:
    """Masks under a wide Gaussian, on a coarse grid.

    A step that moves by less than the Gaussian's deviation changes the smoothed mask in proportion, whatever
    the phase of the pixels is: that is what a linear model of the masks needs. Wrinkles of the outline, which
    no two meshes have alike, are smaller and count for little. Binary masks, as a segmentation gives them,
    mean the same as antialiased ones. Distance fields were tried and are far from linear: wherever a fold of
    the hem comes or goes, they jump in a whole region.

    Attributes:
        grid: cells along the image's width; the deviation is one of them.
    """

    grid: Count = 32

    def __call__(self, masks: Floats) -> Floats:
        """Of masks (C, 2, F, h, w): (C, 2, F, grid h / w, grid).

        Raises:
            InputError: images smaller than the grid.
        """
        cell = masks.shape[-1] / self.grid
        if cell < 1:
            raise InputError(
                "Masks are too small",
                where="masks",
                expected=f"at least {self.grid} px across",
                got=f"{masks.shape[-1]} px",
            )
        smooth = gaussian_filter(masks, (0, 0, 0, cell, cell), mode="nearest")
        rows, columns = (
            ((np.arange(int(size / cell)) + 0.5) * cell).astype(np.int64) for size in masks.shape[-2:]
        )
        found: Floats = smooth[..., rows[:, None], columns]
        return found
