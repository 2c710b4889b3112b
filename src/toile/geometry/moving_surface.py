"""Nearest points on a triangle mesh that moves from one question to the next, by a bounding volume tree.

The tree is Warp's, in single precision; what it finds is evaluated again in double precision. Near an edge or
a corner the side of a point is told by angle-weighted normals (Bærentzen and Aanæs, Signed distance
computation using the angle weighted pseudonormal, IEEE Transactions on Visualization and Computer Graphics
11(3), 2005), so that a surface need not be closed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from toile.geometry.moving_surface_kernels import nearest_places, ray_hits
from toile.warp_runtime import start_warp, view

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

# Closer than this to the surface [m] single precision gives no direction to the nearest point.
_CLOSE = 5e-5


@dataclass(frozen=True)
class Nearest:
    """Nearest points on a surface of those asked for that are within reach, M of them.

    Attributes:
        which: (M,) their numbers among those asked for.
        faces: (M,) faces that the nearest points lie in.
        weights: (M, 3) barycentric coordinates there.
        points: (M, 3) nearest points [m].
        normals: (M, 3) unit gradients of the distance; of the signed one they point out of the surface.
        distances: (M,) [m], negative behind the surface if they were asked for with a sign.
    """

    which: Indices
    faces: Indices
    weights: Array
    points: Array
    normals: Array
    distances: Array


class MovingSurface:
    """A triangle mesh whose vertices move.

    Args:
        n_vertices: V.
        faces: (T, 3), counter-clockwise seen from outside.
    """

    def __init__(self, n_vertices: int, faces: Indices) -> None:
        start_warp()
        self.faces = np.ascontiguousarray(faces, np.int64)
        self._used = np.unique(self.faces)
        number = np.zeros(n_vertices, np.int32)
        number[self._used] = np.arange(len(self._used))
        self._triangles = np.ascontiguousarray(number[self.faces].reshape(-1))
        self._points = np.zeros((len(self._used), 3), np.float32)
        self._vertices = np.zeros((n_vertices, 3))
        self._centre = np.zeros(3)
        self._mesh: Any = None

    def move(self, vertices: Array) -> None:
        """Put the vertices to (V, 3) [m]."""
        self._vertices = np.asarray(vertices, np.float64)
        used = self._vertices[self._used]
        # Single precision is finest near the origin.
        self._centre = used.mean(0)
        self._points[:] = used - self._centre
        if self._mesh is None:
            self._mesh = wp.Mesh(view(self._points, wp.vec3f), view(self._triangles, wp.int32))
        else:
            self._mesh.refit()

    def nearest(self, points: Array, reach: float, *, signed: bool = True) -> Nearest:
        """Nearest points of (P, 3) [m] that are within ``reach`` [m]."""
        asked = np.ascontiguousarray(points - self._centre, np.float32)
        faces = np.empty(len(asked), np.int32)
        places = np.empty((len(asked), 3), np.float32)
        wp.launch(
            nearest_places,
            dim=len(asked),
            inputs=[
                self._mesh.id,
                view(asked, wp.vec3f),
                reach,
                signed,
                view(faces, wp.int32),
                view(places, wp.vec3f),
            ],
            device="cpu",
        )
        which = np.flatnonzero(faces >= 0)
        face = faces[which].astype(np.int64)
        weights = np.empty((len(which), 3))
        weights[:, :2] = places[which, :2]
        weights[:, 2] = 1.0 - weights[:, 0] - weights[:, 1]
        weights = weights.clip(0.0, 1.0)
        weights /= weights.sum(1, keepdims=True)
        corners = self._vertices[self.faces[face]]
        on = np.einsum("mc,mck->mk", weights, corners)
        away = points[which] - on
        length = np.sqrt(np.einsum("mk,mk->m", away, away))
        distances = length * places[which, 2]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.sqrt(np.einsum("mk,mk->m", normals, normals)).clip(min=1e-30)[:, None]
        off = length > _CLOSE
        normals[off] = away[off] / distances[off, None]
        return Nearest(which, face, weights, on, normals, distances)

    def hits(self, points: Array, directions: Array, reach: float) -> Array:
        """Distances [m] along rays (P, 3) of unit directions (P, 3) to the surface; inf beyond ``reach``."""
        asked = np.ascontiguousarray(points - self._centre, np.float32)
        along = np.ascontiguousarray(directions, np.float32)
        found = np.empty(len(asked), np.float32)
        wp.launch(
            ray_hits,
            dim=len(asked),
            inputs=[
                self._mesh.id,
                view(asked, wp.vec3f),
                view(along, wp.vec3f),
                reach,
                view(found, wp.float32),
            ],
            device="cpu",
        )
        return np.where(found < 0, np.inf, found.astype(np.float64))
