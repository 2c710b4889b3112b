"""Chamfer distance between a reconstructed mesh and a ground-truth point cloud (Eq. 18)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from toile.errors import InputError
from toile.geometry.mesh import sample_surface

CHAMFER_PROTOCOL = (
    "squared symmetric Chamfer distance (Stotko et al., CVPR 2024, Eq. 18): sum of the two one-sided means "
    "of squared nearest-neighbour distances, ×1e4 m²; as many area-weighted surface samples as "
    "ground-truth points, sampling seed = seed + frame; unaligned (no ICP, no scaling); mean over all "
    "frames including frame 0"
)
"""What a squared Chamfer number of this project means. Printed beside every such number."""

CHAMFER_L1_PROTOCOL = (
    "L1 Chamfer distance: average (half the sum) of the two one-sided means of Euclidean nearest-neighbour "
    "distances, mm; same samples as the squared Chamfer distance; unaligned; mean over all frames "
    "including frame 0"
)
"""What an L1 Chamfer number of this project means. Printed beside every such number."""

CHAMFER_SCALE = 1e4
"""Squared Chamfer distances in m² are multiplied by this for reading, as in the literature."""


@dataclass(frozen=True)
class NearestDistances:
    """Nearest-neighbour distances between two point sets R and T.

    Attributes:
        to_target: distance of every point of R to the nearest point of T, (n_R,) [m].
        to_reconstruction: distance of every point of T to the nearest point of R, (n_T,) [m].
    """

    to_target: npt.NDArray[np.float64]
    to_reconstruction: npt.NDArray[np.float64]

    @property
    def squared_chamfer(self) -> float:
        """C(R, T) of Eq. 18 [m²], not yet multiplied by 1e4."""
        return float(np.mean(self.to_target**2) + np.mean(self.to_reconstruction**2))

    @property
    def l1_chamfer(self) -> float:
        """Average of the two one-sided mean distances [m]."""
        return float(0.5 * (np.mean(self.to_target) + np.mean(self.to_reconstruction)))


def nearest_distances(reconstruction: Tensor, target: Tensor) -> NearestDistances:
    """Nearest-neighbour distances both ways, in float64, exact (k-d tree, one thread).

    Args:
        reconstruction: points R (n_R, 3) [m].
        target: points T (n_T, 3) [m].

    Raises:
        InputError: a point set is empty, not (n, 3) or not finite.
    """
    r, t = _points(reconstruction, "reconstruction"), _points(target, "target")
    to_target, _ = cKDTree(t).query(r, workers=1)
    to_reconstruction, _ = cKDTree(r).query(t, workers=1)
    return NearestDistances(np.asarray(to_target), np.asarray(to_reconstruction))


def sample_like(vertices: Tensor, faces: Tensor, target: Tensor, seed: int) -> Tensor:
    """Draw as many area-weighted surface samples as ``target`` has points, with a generator of their own.

    Args:
        vertices: mesh vertices (V, 3) [m].
        faces: triangles (T, 3).
        target: points (n, 3); only their number is used.
        seed: seed of the generator.

    Returns:
        Samples (n, 3) [m], dtype of ``vertices``.
    """
    generator = torch.Generator().manual_seed(seed)
    return sample_surface(vertices, faces, int(target.shape[0]), generator)


def chamfer_distance(vertices: Tensor, faces: Tensor, target: Tensor, *, seed: int) -> float:
    """Squared symmetric Chamfer distance of one frame [m²], Eq. 18, unaligned (see ``CHAMFER_PROTOCOL``).

    Args:
        vertices: reconstructed mesh vertices (V, 3) [m].
        faces: triangles (T, 3).
        target: ground-truth points (n, 3) [m].
        seed: seed of the surface sampling.
    """
    samples = sample_like(vertices.detach().double().cpu(), faces.cpu(), target, seed)
    return nearest_distances(samples, target).squared_chamfer


def _points(points: Tensor, name: str) -> npt.NDArray[np.float64]:
    array = points.detach().cpu().double().numpy()
    if array.ndim != 2 or array.shape[1] != 3 or array.shape[0] == 0 or not np.isfinite(array).all():
        raise InputError(
            "Unusable point set for the Chamfer distance",
            where=name,
            expected="at least one finite point, shape (n, 3) in metres",
            got=f"shape {tuple(array.shape)}, {int((~np.isfinite(array)).sum())} non-finite numbers",
        )
    return array
