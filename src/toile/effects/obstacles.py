"""Rigid obstacles that stand still, in the camera's frame."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path

import igl
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import normalize

from toile.errors import InputError
from toile.geometry.io import read_mesh
from toile.geometry.surface import triangle_mesh

Array = NDArray[np.float64]

_FAR = 1e3
"""Distance of nothing [m]."""


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

    def curvature(self, positions: Array) -> Array | None:
        """Second derivatives of the distance (N, 3, 3) [1/m]; None where no closed form gives them."""
        return None


class Nowhere(Obstacle):
    """No obstacle that anybody knows of: nothing comes near it."""

    def distance(self, positions: Tensor, earlier: Tensor) -> Tensor:
        """See Obstacle."""
        return _FAR + 0.0 * positions.sum(-1)

    def normals(self, positions: Tensor) -> Tensor:
        """See Obstacle."""
        return torch.zeros_like(positions)

    def curvature(self, positions: Array) -> Array:
        """See Obstacle."""
        return np.zeros((len(positions), 3, 3))


class Plane(Obstacle):
    """A half space.

    Args:
        point: on its surface (3,) [m].
        normal: out of it (3,), of any length.
    """

    def __init__(self, point: Sequence[float], normal: Sequence[float]) -> None:
        self.point, normals = _vector(point, "point"), _vector(normal, "normal")
        if not float(normals.norm()) > 0:
            raise InputError(
                "a plane needs a normal", where="obstacle=plane", expected="a vector other than 0", got="0"
            )
        self.normal = normalize(normals, dim=0)

    def distance(self, positions: Tensor, earlier: Tensor) -> Tensor:
        """See Obstacle."""
        return (positions - self.point) @ self.normal

    def normals(self, positions: Tensor) -> Tensor:
        """See Obstacle."""
        return self.normal.expand_as(positions)

    def curvature(self, positions: Array) -> Array:
        """See Obstacle."""
        return np.zeros((len(positions), 3, 3))


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
        self.centre, self.radius = _vector(centre, "centre"), radius

    def distance(self, positions: Tensor, earlier: Tensor) -> Tensor:
        """See Obstacle."""
        return (positions - self.centre).norm(dim=-1) - self.radius

    def normals(self, positions: Tensor) -> Tensor:
        """See Obstacle."""
        return normalize(positions - self.centre, dim=-1)

    def curvature(self, positions: Array) -> Array:
        """See Obstacle."""
        away = positions - self.centre.numpy()
        distance = np.linalg.norm(away, axis=-1)[:, None, None]
        return (np.eye(3) - away[:, :, None] * away[:, None, :] / distance**2) / distance


class TriangleMesh(Obstacle):
    """A closed surface of triangles whose faces turn counter-clockwise seen from outside.

    Within a step it is the plane through the nearest point across the direction to it, both taken where the
    step begins. Derivatives are those of that plane: they leave out that near an edge its direction changes.
    Inside and outside are told by angle-weighted pseudonormals (Bærentzen and Aanæs, IEEE Transactions on
    Visualization and Computer Graphics 11(3), 2005).

    Args:
        vertices: (V, 3) [m].
        faces: (T, 3) vertex indices.
    """

    def __init__(self, vertices: Tensor, faces: Tensor) -> None:
        self._vertices = np.ascontiguousarray(vertices.detach().double().numpy())
        self._faces = np.ascontiguousarray(faces.numpy())
        empty = int((igl.doublearea(self._vertices, self._faces) <= 0).sum()) if len(faces) else 0
        if empty or not len(faces):
            raise InputError(
                "mesh cannot be an obstacle",
                where="obstacle=mesh",
                expected="triangles of a positive area",
                got=f"{empty} of {len(faces)} without",
            )
        self._last: tuple[Array, Tensor, Tensor] | None = None

    @staticmethod
    def read(path: Path | str) -> TriangleMesh:
        """The mesh in a file, in metres; polygons are cut into triangles, coincident vertices joined.

        Raises:
            InputError: the file cannot be read.
        """
        mesh = triangle_mesh(read_mesh(path), str(path))
        return TriangleMesh(torch.from_numpy(mesh.vertices), torch.from_numpy(mesh.faces))

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
        distances, _, nearest, normals = igl.signed_distance(
            points, self._vertices, self._faces, igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL
        )
        # On the surface there is no direction to the nearest point.
        off = np.abs(distances) > 1e-9
        normals[off] = (points[off] - nearest[off]) / distances[off, None]
        return torch.from_numpy(nearest), torch.from_numpy(normals)


def _vector(values: Sequence[float], name: str) -> Tensor:
    vector = torch.tensor([float(v) for v in values], dtype=torch.float64)
    if vector.shape != (3,):
        raise InputError(
            f"{name} of an obstacle", where="obstacle", expected="3 numbers [m]", got=str(len(vector))
        )
    return vector
