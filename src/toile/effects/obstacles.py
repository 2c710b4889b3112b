"""Rigid obstacles that stand still, in the camera's frame."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import normalize

from toile.errors import InputError
from toile.geometry.io import read_mesh

Array = NDArray[np.float64]


class Obstacle(ABC):
    """Something solid."""

    @abstractmethod
    def distance(self, positions: Tensor, earlier: Tensor) -> Tensor:
        """Signed distance (N,) [m], negative inside.

        Args:
            positions: where it is asked for (N, 3) [m].
            earlier: where the step began (N, 3) [m]; an obstacle may be linearised there.
        """

    @abstractmethod
    def normals(self, positions: Tensor) -> Tensor:
        """Unit vectors out of the obstacle, gradients of the distance, (N, 3)."""


class Plane(Obstacle):
    """A half space.

    Args:
        point: on its surface (3,) [m].
        normal: out of it (3,), of any length.
    """

    def __init__(self, point: Sequence[float], normal: Sequence[float]) -> None:
        self._point, normals = _vector(point, "point"), _vector(normal, "normal")
        if not float(normals.norm()) > 0:
            raise InputError(
                "a plane needs a normal", where="obstacle=plane", expected="a vector other than 0", got="0"
            )
        self._normal = normalize(normals, dim=0)

    def distance(self, positions: Tensor, earlier: Tensor) -> Tensor:
        """See Obstacle."""
        return (positions - self._point) @ self._normal

    def normals(self, positions: Tensor) -> Tensor:
        """See Obstacle."""
        return self._normal.expand_as(positions)


class Sphere(Obstacle):
    """A ball.

    Args:
        centre: (3,) [m].
        radius: [m].
    """

    def __init__(self, centre: Sequence[float], radius: float) -> None:
        if not radius > 0:
            raise InputError(
                "a sphere needs a radius", where="obstacle=sphere", expected="> 0 m", got=f"{radius:g}"
            )
        self._centre, self._radius = _vector(centre, "centre"), radius

    def distance(self, positions: Tensor, earlier: Tensor) -> Tensor:
        """See Obstacle."""
        return (positions - self._centre).norm(dim=-1) - self._radius

    def normals(self, positions: Tensor) -> Tensor:
        """See Obstacle."""
        return normalize(positions - self._centre, dim=-1)


class TriangleMesh(Obstacle):
    """A closed surface of triangles whose faces turn counter-clockwise seen from outside.

    Within a step it is the plane through the nearest point across the direction to it, both taken where the
    step begins. Derivatives are those of that plane: they leave out that near an edge its direction changes.

    Args:
        vertices: (V, 3) [m].
        faces: (T, 3) vertex indices.
    """

    def __init__(self, vertices: Tensor, faces: Tensor) -> None:
        self._triangles: Array = vertices.detach().double().numpy()[faces.numpy()]
        a, b, c = self._triangles.swapaxes(0, 1)
        normals = np.cross(b - a, c - a)
        areas = np.linalg.norm(normals, axis=-1)
        if not (len(faces) and areas.min() > 0):
            raise InputError(
                "mesh cannot be an obstacle",
                where="obstacle=mesh",
                expected="triangles of a positive area",
                got=f"{int((areas == 0).sum())} of {len(faces)} without",
            )
        self._normals = normals / areas[:, None]
        centres = self._triangles.mean(1)
        self._reach = float(np.linalg.norm(self._triangles - centres[:, None], axis=-1).max())
        self._last: tuple[Array, Tensor, Tensor] | None = None
        self._centres, self._corners = cKDTree(centres), cKDTree(self._triangles.reshape(-1, 3))

    @staticmethod
    def read(path: Path | str) -> TriangleMesh:
        """The mesh in a file, in metres; polygons are cut into triangles.

        Raises:
            InputError: the file cannot be read.
        """
        mesh = read_mesh(path)
        faces = [
            (polygon[0], polygon[k], polygon[k + 1])
            for polygon in mesh.polygons
            for k in range(1, len(polygon) - 1)
        ]
        return TriangleMesh(mesh.vertices, torch.tensor(faces, dtype=torch.int64).reshape(-1, 3))

    def distance(self, positions: Tensor, earlier: Tensor) -> Tensor:
        """See Obstacle."""
        nearest, normals = self._nearest(earlier)
        return ((positions - nearest) * normals).sum(-1)

    def normals(self, positions: Tensor) -> Tensor:
        """See Obstacle."""
        return self._nearest(positions)[1]

    def _nearest(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        """Nearest points on the surface and the outward normals there, (N, 3) each, constants."""
        points: Array = positions.detach().double().numpy()
        # Within one step it is asked again and again where the step began.
        if self._last is None or not np.array_equal(self._last[0], points):
            self._last = (points.copy(), *self._search(points))
        return self._last[1], self._last[2]

    def _search(self, points: Array) -> tuple[Tensor, Tensor]:
        # A corner bounds the distance; no face whose centre is farther than that and its reach is nearer.
        bounds = self._corners.query(points)[0] + self._reach
        nearest, normals = np.empty_like(points), np.empty_like(points)
        for i, faces in enumerate(self._centres.query_ball_point(points, bounds * (1 + 1e-12))):
            on_faces = closest_points(self._triangles[faces], points[i])
            away = points[i] - on_faces
            distances = np.linalg.norm(away, axis=-1)
            least = distances.min()
            tied = np.flatnonzero(distances <= least + 1e-12)
            across = (away[tied] * self._normals[faces][tied]).sum(-1)
            # Of faces that share the nearest point, the one most face-on tells inside from outside.
            chosen = int(np.abs(across).argmax())
            face = int(tied[chosen])
            nearest[i] = on_faces[face]
            normals[i] = self._normals[faces[face]]
            if least > 1e-9:
                normals[i] = away[face] / distances[face] * np.sign(across[chosen])
        return torch.from_numpy(nearest), torch.from_numpy(normals)


def closest_points(triangles: Array, point: Array) -> Array:
    """Point of every triangle (T, 3, 3) that is nearest to a point (3,); (T, 3).

    Source: Ericson, Real-Time Collision Detection, 2005, section 5.1.5.
    """
    a, b, c = triangles.swapaxes(0, 1)
    ab, ac = b - a, c - a
    d1, d2 = (((point - a) * e).sum(-1) for e in (ab, ac))
    d3, d4 = (((point - b) * e).sum(-1) for e in (ab, ac))
    d5, d6 = (((point - c) * e).sum(-1) for e in (ab, ac))
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    with np.errstate(divide="ignore", invalid="ignore"):
        inside = a + (vb / (va + vb + vc))[:, None] * ab + (vc / (va + vb + vc))[:, None] * ac
        on_ab = a + (d1 / (d1 - d3))[:, None] * ab
        on_ac = a + (d2 / (d2 - d6))[:, None] * ac
        on_bc = b + ((d4 - d3) / ((d4 - d3) + (d5 - d6)))[:, None] * (c - b)
    cases = [
        ((d1 <= 0) & (d2 <= 0), a),
        ((d3 >= 0) & (d4 <= d3), b),
        ((d6 >= 0) & (d5 <= d6), c),
        ((vc <= 0) & (d1 >= 0) & (d3 <= 0), on_ab),
        ((vb <= 0) & (d2 >= 0) & (d6 <= 0), on_ac),
        ((va <= 0) & (d4 - d3 >= 0) & (d5 - d6 >= 0), on_bc),
    ]
    found: Array = np.select([c[:, None] for c, _ in cases], [p for _, p in cases], inside)
    return found


def _vector(values: Sequence[float], name: str) -> Tensor:
    vector = torch.tensor([float(v) for v in values], dtype=torch.float64)
    if vector.shape != (3,):
        raise InputError(
            f"{name} of an obstacle", where="obstacle", expected="3 numbers [m]", got=str(len(vector))
        )
    return vector
