"""From which frame on tracking has lost the cloth, told by its outline.

A cloth that folds over where the image shows it flat hides its points, and hidden points cost nothing; a
print that repeats can be taken for its neighbour. The outline tells.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from toile.evaluation.silhouette import intersection_over_union
from toile.limits import Fraction, Positive
from toile.reconstruction.problem import Reconstruction

Array = NDArray[np.float64]

LEAST = 0.9
"""See first_lost."""


def outline_overlap(reconstruction: Reconstruction, positions: Array) -> Array:
    """Intersection over union (F,) of silhouette and mask in the first frames, at positions (F, N, 3) [m]."""
    scene = reconstruction.scene
    overlap = np.empty(len(positions))
    for frame, x in enumerate(torch.from_numpy(positions)):
        seen = reconstruction.renderer.rasterize(x[None], reconstruction.faces, scene.camera).face[0] >= 0
        overlap[frame] = float(intersection_over_union(seen.double(), scene.masks[frame]))
    return overlap


def first_lost(overlap: Array, least: float = LEAST) -> int:
    """First frame whose outline overlaps far less than that of frame 0; the number of frames if none does.

    Args:
        overlap: of every frame (F,).
        least: share of frame 0's overlap. A wrong camera or mask lowers it in all frames alike; a tracked
            cloth that has folded over, or slipped by a print's period, lowers it later.
    """
    lost = np.flatnonzero(overlap < least * overlap[0])
    return int(lost[0]) if len(lost) else len(overlap)


@dataclass(frozen=True)
class LostClothGuard:
    """What a fit does where its outline says that the cloth is lost.

    Attributes:
        mask_factor: by how much the silhouette weighs more in the first stage of a second try; None: there is
            no second try, and what is lost is only said.
        least_overlap: of outline and mask, as a share of frame 0's; with less the cloth is lost.
    """

    mask_factor: Positive | None = 10.0
    least_overlap: Fraction = LEAST

    def first_lost(self, reconstruction: Reconstruction, trajectory: torch.Tensor) -> int:
        """First frame of a trajectory (F, H, W, 3) [m] in which the cloth is lost, or F."""
        overlap = outline_overlap(reconstruction, trajectory.flatten(1, 2).numpy())
        return first_lost(overlap, self.least_overlap)
