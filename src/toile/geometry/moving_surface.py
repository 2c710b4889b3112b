"""Nearest points on a triangle mesh that moves from one question to the next, by a bounding volume tree.

The tree is Warp's, in single precision; on the face that it finds double precision goes on. Near an edge or
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

from toile.geometry.moving_surface_kernels import nearest_places, other_walls, ray_hits
from toile.warp_runtime import start_warp, view

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


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

    def some(self, kept: Indices) -> Nearest:
        """Only those at the places ``kept`` (M',)."""
        return Nearest(
            self.which[kept],
            self.faces[kept],
            self.weights[kept],
            self.points[kept],
            self.normals[kept],
            self.distances[kept],
        )

    def joined(self, other: Nearest, which: Indices) -> Nearest:
        """With the points of another answer, whose numbers among those asked for are ``which``."""
        return Nearest(
            np.concatenate((self.which, which)),
            np.concatenate((self.faces, other.faces)),
            np.concatenate((self.weights, other.weights)),
            np.concatenate((self.points, other.points)),
            np.concatenate((self.normals, other.normals)),
            np.concatenate((self.distances, other.distances)),
        )


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
        triangles = np.ascontiguousarray(number[self.faces])
        self._triangles_view = view(triangles, wp.int32)
        self._corners = view(triangles.reshape(-1), wp.int32)
        self._exact = np.zeros((len(self._used), 3))
        self._exact_view = view(self._exact, wp.vec3d)
        self._points = np.zeros((len(self._used), 3), np.float32)
        self._centre = np.zeros(3)
        self._mesh: Any = None

    def move(self, vertices: Array) -> None:
        """Put the vertices to (V, 3) [m]."""
        used = np.asarray(vertices, np.float64)[self._used]
        # Single precision is finest near the origin.
        self._centre = used.mean(0)
        np.subtract(used, self._centre, out=self._exact)
        self._points[:] = self._exact
        if self._mesh is None:
            self._mesh = wp.Mesh(view(self._points, wp.vec3f), self._corners)
        else:
            self._mesh.refit()

    def nearest(self, points: Array, reach: float, *, signed: bool = True) -> Nearest:
        """Nearest points of (P, 3) [m] that are within ``reach`` [m]."""
        return self._launch(nearest_places, points, [reach, signed])

    def other_walls(
        self, points: Array, walls: Array, directions: Array, reach: float, turned: float
    ) -> Nearest:
        """Nearest points (with a sign) on walls that make a crease with the nearest ones.

        In a crease a point has more than one wall beside it.

        Args:
            points: (P, 3) [m].
            walls: (P, 3) [m], nearest points.
            directions: (P, 3) unit vectors, normals there.
            reach: within which walls are looked for [m].
            turned: cosine between direction and wall below which it is another one.
        """
        at, along = np.ascontiguousarray(walls - self._centre), np.ascontiguousarray(directions)
        known = [view(at, wp.vec3d), view(along, wp.vec3d)]
        return self._launch(other_walls, points, [*known, reach, turned])

    def _launch(self, kernel: Any, points: Array, inputs: list[Any]) -> Nearest:
        n = len(points)
        asked = np.ascontiguousarray(points - self._centre)
        faces = np.empty(n, np.int32)
        weights, nearest, normals = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 3))
        distances = np.empty(n)
        wp.launch(
            kernel,
            dim=n,
            inputs=[
                self._mesh.id,
                self._exact_view,
                self._triangles_view,
                view(asked, wp.vec3d),
                *inputs,
                view(faces, wp.int32),
                view(weights, wp.vec3d),
                view(nearest, wp.vec3d),
                view(normals, wp.vec3d),
                view(distances, wp.float64),
            ],
            device="cpu",
        )
        which = np.flatnonzero(faces >= 0)
        return Nearest(
            which,
            faces[which].astype(np.int64),
            weights[which],
            nearest[which] + self._centre,
            normals[which],
            distances[which],
        )

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
