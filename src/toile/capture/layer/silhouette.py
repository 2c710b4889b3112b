"""The multi-view silhouette constraint inside the simulation layer.

Eq. 1 of Li et al., Deep Physics-aware Inference of Cloth Deformation for Monocular Human Performance
Capture, 3DV 2021: Σ_p ‖Ṽ_p - V_ray,p‖² over the silhouette pixels p of all views, Ṽ_p the nearest boundary
vertex of the cloth and V_ray,p its nearest point on the pixel's ray. Which vertex belongs to which pixel is
frozen within a solve.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import KDTree
from torch import Tensor

from toile.geometry.camera import Camera
from toile.physics.implicit.linear_solvers.pattern import BlockPattern
from toile.physics.implicit.renewed import RenewedPotential
from toile.physics.topology import Topology

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True)
class SilhouetteRays:
    """Rays through the silhouette pixels of one view.

    Attributes:
        origin: centre of the camera in the world (3,) [m].
        directions: (P, 3) unit vectors.
    """

    origin: Array
    directions: Array

    @staticmethod
    def of_pixels(camera: Camera, pixels: Array) -> SilhouetteRays:
        """Rays through points (P, 2) of the image, as (x, y) [px]."""
        seen = np.column_stack(
            (
                (pixels[:, 0] - camera.cx) / camera.fx,
                (pixels[:, 1] - camera.cy) / camera.fy,
                np.ones(len(pixels)),
            )
        )
        directions = seen @ camera.R.numpy()
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        return SilhouetteRays(camera.centre.numpy(), directions)

    @staticmethod
    def of_mask(camera: Camera, garment: NDArray[np.bool_], person: NDArray[np.bool_]) -> SilhouetteRays:
        """Rays between pixels of the garment and of the background, from masks (H, W); the body is no rim."""
        rows, columns = [], []
        for axis in (0, 1):
            for step in (1, -1):
                outside = np.roll(~person, -step, axis)
                edge = [slice(None), slice(None)]
                edge[axis] = slice(-1, None) if step == 1 else slice(0, 1)
                outside[tuple(edge)] = False
                row, column = np.nonzero(garment & outside)
                rows.append(row + 0.5 + (0.5 * step if axis == 0 else 0.0))
                columns.append(column + 0.5 + (0.5 * step if axis == 1 else 0.0))
        pixels = np.column_stack((np.concatenate(columns), np.concatenate(rows)))
        return SilhouetteRays.of_pixels(camera, pixels)


class SilhouettePotential(RenewedPotential):
    """Eq. 1 as a potential, w Σ_p ‖Ṽ_p - V_ray,p‖².

    Args:
        topology: of the cloth.
        views: rays of every view.
        weight: w [N/m], for one pixel.
        reach: pixels farther than this from the cloth count for nothing [m].
        x: where the first solve begins (N, 3) [m].
    """

    def __init__(
        self, topology: Topology, views: Sequence[SilhouetteRays], weight: float, reach: float, x: Array
    ) -> None:
        self._topology, self._views = topology, views
        self._weight, self._reach = weight, reach
        self.renew(x)

    def renew(self, x: Array) -> None:
        """See RenewedPotential."""
        n = len(x)
        # ½ xᵀ A x - xᵀ b + c, block by block.
        self._matrices = np.zeros((n, 3, 3))
        self._right = np.zeros((n, 3))
        self._constant = 0.0
        for view in self._views:
            pixel, vertex = self._pairs(view, x)
            d = view.directions[pixel]
            across = 2 * self._weight * (np.eye(3) - d[:, :, None] * d[:, None, :])
            pulled = across @ view.origin
            np.add.at(self._matrices, vertex, across)
            np.add.at(self._right, vertex, pulled)
            self._constant += 0.5 * float(pulled.sum(0) @ view.origin)

    def total(self, x: Array, free: Array) -> float:
        """See StepPotential."""
        half = 0.5 * np.einsum("nij,nj->ni", self._matrices, x) - self._right
        return float((half * x).sum()) + self._constant

    def gradient(self, x: Array) -> Array:
        """See StepPotential."""
        gradient: Array = np.einsum("nij,nj->ni", self._matrices, x) - self._right
        return gradient

    def add_hessian(self, blocks: Array, pattern: BlockPattern, x: Array, *, convex: bool) -> None:
        """See StepPotential; it is convex."""
        blocks[pattern.diagonal] += self._matrices

    def forces(self, x: Tensor, positions: Tensor) -> Tensor:
        """See RenewedPotential; nothing here depends on where the step begins."""
        return torch.from_numpy(-self.gradient(x.detach().numpy()))

    def _pairs(self, view: SilhouetteRays, x: Array) -> tuple[Indices, Indices]:
        """Pixels that a boundary vertex is near to, and that vertex."""
        boundary = contour(self._topology, x, view.origin)
        away = x[boundary] - view.origin
        distance = np.linalg.norm(away, axis=1, keepdims=True)
        if not len(boundary) or not len(view.directions):
            return np.zeros(0, np.int64), np.zeros(0, np.int64)
        chord, nearest = KDTree(away / distance).query(view.directions)
        near = chord * distance[nearest, 0] < self._reach
        return np.flatnonzero(near), boundary[nearest[near]]


def contour(topology: Topology, x: Array, eye: Array) -> Indices:
    """Vertices where the surface turns away from the eye (3,), and those on its rims."""
    hinges = topology.hinges.numpy()
    a, b, c, d = (x[hinges[:, k]] for k in range(4))
    first, second = np.cross(b - a, c - a), np.cross(d - a, b - a)
    front = np.einsum("ik,ik->i", first, a - eye), np.einsum("ik,ik->i", second, a - eye)
    turning = hinges[front[0] * front[1] <= 0.0, :2]
    rims = np.concatenate([loop.numpy() for loop in topology.boundary] or [np.zeros(0, np.int64)])
    return np.unique(np.concatenate((turning.reshape(-1), rims)))
