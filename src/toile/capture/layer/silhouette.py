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
from scipy.ndimage import gaussian_filter
from scipy.sparse import csr_array
from scipy.spatial import KDTree
from torch import Tensor

from toile.geometry.camera import Camera
from toile.geometry.mesh import vertex_normals
from toile.geometry.moving_surface import MovingSurface
from toile.physics.implicit.linear_solvers.pattern import BlockPattern
from toile.physics.implicit.renewed import RenewedPotential
from toile.physics.topology import Topology

# Standard deviation of the blur whose slope says where the background is [px].
_BLUR = 1.5
# How far beside a vertex nothing may be for it to be on the outline [m].
_BESIDE = 4e-3
# Vertices among which a pixel finds one whose background lies to the same side, and cosine of same.
_NEIGHBOURS = 6
_SAME_SIDE = 0.3

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True)
class SilhouetteRays:
    """Rays through the silhouette pixels of one view.

    Attributes:
        origin: centre of the camera in the world (3,) [m].
        directions: (P, 3) unit vectors.
        outward: (P, 3) unit vectors across the rays, towards the background.
    """

    origin: Array
    directions: Array
    outward: Array

    @staticmethod
    def of_mask(camera: Camera, garment: NDArray[np.bool_], person: NDArray[np.bool_]) -> SilhouetteRays:
        """Rays between pixels of the garment and of the background, from masks (H, W); the body is no rim."""
        smooth = gaussian_filter(person.astype(np.float64), _BLUR)
        slope = -np.stack(np.gradient(smooth)[::-1], -1)
        pixels, outward = [], []
        for axis, step in ((0, 1), (0, -1), (1, 1), (1, -1)):
            outside = np.roll(~person, -step, axis)
            # What leaves the image is no silhouette.
            np.moveaxis(outside, axis, 0)[-1 if step == 1 else 0] = False
            row, column = np.nonzero(garment & outside)
            between = np.column_stack((column + 0.5, row + 0.5))
            between[:, 1 - axis] += 0.5 * step
            pixels.append(between)
            outward.append(slope[row, column])
        return SilhouetteRays._of_pixels(camera, np.concatenate(pixels), np.concatenate(outward))

    @staticmethod
    def _of_pixels(camera: Camera, pixels: Array, outward: Array) -> SilhouetteRays:
        """Rays through points (P, 2) of the image, as (x, y) [px], and what is outward there (P, 2)."""
        R = camera.R.numpy()
        focal = np.array([camera.fx, camera.fy])
        flat = (pixels - np.array([camera.cx, camera.cy])) / focal
        directions = _unit(np.column_stack((flat, np.ones(len(flat)))) @ R)
        across = np.column_stack((outward / focal, np.zeros(len(flat)))) @ R
        across -= np.einsum("pk,pk->p", across, directions)[:, None] * directions
        return SilhouetteRays(camera.centre.numpy(), directions, _unit(across))


class Outline:
    """Finds the vertices of a cloth that its outline in a view goes through.

    Args:
        topology: of the cloth.
        body: what else hides the background; its owner moves it.
    """

    def __init__(self, topology: Topology, body: MovingSurface) -> None:
        self._topology, self._body = topology, body
        self._cloth = MovingSurface(topology.n_vertices, topology.faces.numpy())
        rims = [loop.numpy() for loop in topology.boundary]
        self._rims = np.concatenate(rims) if rims else np.zeros(0, np.int64)
        self._mean = _neighbour_mean(topology)

    def move(self, x: Array) -> None:
        """Put the cloth to (N, 3) [m]."""
        self._x = x
        self._cloth.move(x)
        self._normals = vertex_normals(torch.from_numpy(x), self._topology.faces).numpy()
        self._away = x - self._mean @ x

    def of(self, eye: Array) -> tuple[Indices, Array]:
        """Boundary vertices seen from the eye (3,), and directions (M, 3) across the ray where nothing is.

        Those where the surface turns away from the eye and those of its rims, if a ray that passes them by on
        one side meets neither cloth nor body.
        """
        x = self._x
        turning = contour(self._topology, x, eye)
        vertex = np.concatenate((turning, turning, self._rims, self._rims))
        normal = self._normals
        ways = np.concatenate(
            (normal[turning], -normal[turning], self._away[self._rims], -self._away[self._rims])
        )
        ray = _unit(x[vertex] - eye)
        ways = _unit(ways - np.einsum("mk,mk->m", ways, ray)[:, None] * ray)
        beside = _unit(x[vertex] + _BESIDE * ways - eye)
        eyes = np.broadcast_to(eye, beside.shape)
        far = 2.0 * float(np.linalg.norm(x - eye, axis=1).max())
        free = np.isinf(self._cloth.hits(eyes, beside, far)) & np.isinf(self._body.hits(eyes, beside, far))
        return vertex[free], ways[free]


class SilhouettePotential(RenewedPotential):
    """Eq. 1 as a potential, w Σ_p ‖Ṽ_p - V_ray,p‖².

    A pixel's vertex is the nearest one on the outline whose background lies to the same side. Of the distance
    the part along the silhouette may count less: a pixel says nothing about where along it a vertex is, and
    pixels all around hold a vertex where it happens to be.

    Args:
        outline: of the cloth.
        views: rays of every view.
        weight: w [N/m], for one pixel.
        along: share of w along the silhouette; 1 in Eq. 1.
        reach: pixels farther than this from the cloth count for nothing [m].
        x: where the first solve begins (N, 3) [m].
    """

    def __init__(
        self,
        outline: Outline,
        views: Sequence[SilhouetteRays],
        weight: float,
        along: float,
        reach: float,
        x: Array,
    ) -> None:
        self._outline, self._views = outline, views
        self._weight, self._along, self._reach = weight, along, reach
        self.renew(x)

    def renew(self, x: Array) -> None:
        """See RenewedPotential."""
        n = len(x)
        # ½ xᵀ A x - xᵀ b + c, block by block.
        self._matrices = np.zeros((n, 3, 3))
        self._right = np.zeros((n, 3))
        self._constant = 0.0
        self._outline.move(x)
        for view in self._views:
            pixel, vertex = self._pairs(view, x)
            d, o = view.directions[pixel], view.outward[pixel]
            outward = o[:, :, None] * o[:, None, :]
            along = np.eye(3) - d[:, :, None] * d[:, None, :] - outward
            across = 2 * self._weight * (outward + self._along * along)
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

    def forces(self, x: Tensor, positions: Tensor, renewed: Tensor) -> Tensor:
        """See RenewedPotential; with the pairs given nothing depends on where the cloth was."""
        return torch.from_numpy(-self.gradient(x.detach().numpy()))

    def _pairs(self, view: SilhouetteRays, x: Array) -> tuple[Indices, Indices]:
        """Pixels that a boundary vertex is near to, and that vertex."""
        boundary, ways = self._outline.of(view.origin)
        if not len(boundary) or not len(view.directions):
            return np.zeros(0, np.int64), np.zeros(0, np.int64)
        away = x[boundary] - view.origin
        distance = np.linalg.norm(away, axis=1)
        # The chord between unit vectors; those that look elsewhere are a long way off.
        k = min(_NEIGHBOURS, len(boundary))
        chord, nearest = KDTree(away / distance[:, None]).query(view.directions, k=list(range(1, k + 1)))
        facing = np.einsum("pk,pjk->pj", view.outward, ways[nearest]) > _SAME_SIDE
        chord = np.where(facing, chord, np.inf)
        best = chord.argmin(1)
        rows = np.arange(len(best))
        chosen = nearest[rows, best]
        near = chord[rows, best] * distance[chosen] < self._reach
        return np.flatnonzero(near), boundary[chosen[near]]


def contour(topology: Topology, x: Array, eye: Array) -> Indices:
    """Vertices where the surface turns away from the eye (3,)."""
    hinges = topology.hinges.numpy()
    a, b, c, d = (x[hinges[:, k]] for k in range(4))
    first, second = np.cross(b - a, c - a), np.cross(d - a, b - a)
    front = np.einsum("ik,ik->i", first, a - eye), np.einsum("ik,ik->i", second, a - eye)
    return np.unique(hinges[front[0] * front[1] <= 0.0, :2])


def _neighbour_mean(topology: Topology) -> csr_array:
    """Matrix (N, N) that takes values of vertices to the means over their neighbours."""
    edges = topology.edges.numpy()
    n = topology.n_vertices
    ends = np.concatenate((edges[:, 0], edges[:, 1])), np.concatenate((edges[:, 1], edges[:, 0]))
    counts = np.bincount(ends[0], minlength=n).clip(min=1)
    return csr_array((1.0 / counts[ends[0]], ends), shape=(n, n))


def _unit(vectors: Array) -> Array:
    unit: Array = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True).clip(min=1e-30)
    return unit
