"""Distance of ground-truth points to the reconstructed surface, free of any sampling noise."""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
import numpy.typing as npt
from torch import Tensor

POINT_TO_SURFACE_PROTOCOL = (
    "mean Euclidean distance of all ground-truth points to the nearest point of the reconstructed "
    "triangles, mm; one-sided (parts of the surface that were not observed do not count); unaligned; mean "
    "over all frames"
)


@dataclass(frozen=True)
class ClosestPoints:
    """Closest points of a triangle mesh to n query points.

    Attributes:
        distance: Euclidean distance (n,) [m].
        face: index of the closest triangle (n,).
        point: closest point on it (n, 3) [m].
    """

    distance: npt.NDArray[np.float64]
    face: npt.NDArray[np.int64]
    point: npt.NDArray[np.float64]


def closest_points(points: Tensor, vertices: Tensor, faces: Tensor) -> ClosestPoints:
    """Exact closest points on a triangle mesh (libigl, bounding-volume hierarchy).

    Args:
        points: query points (n, 3) [m].
        vertices: mesh vertices (V, 3) [m].
        faces: triangles (T, 3).
    """
    squared, face, point = igl.point_mesh_squared_distance(
        np.ascontiguousarray(points.detach().cpu().double().numpy()),
        np.ascontiguousarray(vertices.detach().cpu().double().numpy()),
        np.ascontiguousarray(faces.cpu().long().numpy()),
    )
    distance = np.sqrt(np.maximum(np.asarray(squared, dtype=np.float64), 0.0))
    return ClosestPoints(distance, np.asarray(face, dtype=np.int64), np.asarray(point, dtype=np.float64))


def point_to_surface(points: Tensor, vertices: Tensor, faces: Tensor) -> float:
    """Mean distance of ``points`` (n, 3) to the mesh ``vertices`` (V, 3), ``faces`` (T, 3) [m]."""
    return float(closest_points(points, vertices, faces).distance.mean())
