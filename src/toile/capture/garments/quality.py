"""How good the triangles of a garment are, and whether it touches the body."""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from toile.capture.garments.sections import Floats, Indices


@dataclass(frozen=True)
class Clearance:
    """How far a garment is from a body.

    Attributes:
        vertices: signed distance of each garment vertex to the body (N,) [m], negative inside.
        body: signed distance of the body's vertices to the garment, (V,) [m]: positive on the inner side of
            the cloth, negative where a vertex has gone through a face, infinite farther than ``reach`` away
            or beside the cloth.
        crossings: pairs (edge of one mesh, face of the other) that intersect.
    """

    vertices: Floats
    body: Floats
    crossings: int

    @property
    def least(self) -> float:
        """The smaller of both distances [m]."""
        return float(min(self.vertices.min(), self.body.min()))


def clearance(
    garment_vertices: Floats,
    garment_faces: Indices,
    body_vertices: Floats,
    body_faces: Indices,
    reach: float = 0.03,
) -> Clearance:
    """Measure a garment against a body by its vertices, by the body's vertices, and by crossing edges.

    Args:
        garment_vertices: (N, 3) [m].
        garment_faces: (Fg, 3), normals away from the body.
        body_vertices: (V, 3) [m].
        body_faces: (Fb, 3), those that count, e.g. without arms.
        reach: distance up to which a vertex of the body is looked at [m].
    """
    distance, *_ = igl.signed_distance(
        garment_vertices, body_vertices, body_faces, sign_type=igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER
    )
    used = np.unique(body_faces)
    body = np.full(len(body_vertices), np.inf)
    squared, face, closest = igl.point_mesh_squared_distance(
        body_vertices[used], garment_vertices, garment_faces
    )
    corners = garment_vertices[garment_faces[face]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    along = ((closest - body_vertices[used]) * normal).sum(1)
    # Closest at the border: the vertex is beside the cloth, on neither side of it. At a ridge the normal of
    # the face says little.
    straight = np.abs(along) > 0.5 * np.sqrt(squared)
    inside = ~_on_border(garment_vertices, garment_faces, face, closest)
    seen = straight & inside & (squared < reach**2)
    body[used[seen]] = along[seen]
    crossings = crossing_edges(garment_vertices, garment_faces, body_vertices, body_faces)
    crossings += crossing_edges(body_vertices, body_faces, garment_vertices, garment_faces)
    return Clearance(np.asarray(distance, dtype=np.float64).ravel(), body, crossings)


def border_edges(faces: Indices) -> npt.NDArray[np.bool_]:
    """Whether the edge opposite to each corner belongs to one face only, (T, 3)."""
    edges = np.sort(
        np.stack((faces[:, [1, 2]], faces[:, [2, 0]], faces[:, [0, 1]]), 1).reshape(-1, 2), axis=1
    )
    _, inverse, count = np.unique(edges, axis=0, return_inverse=True, return_counts=True)
    return np.asarray(count[inverse.ravel()] == 1).reshape(-1, 3)


def _on_border(vertices: Floats, faces: Indices, face: Indices, points: Floats) -> npt.NDArray[np.bool_]:
    corners = [np.ascontiguousarray(vertices[faces[face, k]]) for k in range(3)]
    barycentric = np.asarray(igl.barycentric_coordinates(np.ascontiguousarray(points), *corners))
    touches = barycentric < 1e-6
    on_edge = (touches & border_edges(faces)[face]).any(1)
    border = np.zeros(len(vertices), dtype=bool)
    opposite = border_edges(faces)
    for corner in range(3):
        border[faces[opposite[:, corner]][:, [(corner + 1) % 3, (corner + 2) % 3]]] = True
    at_vertex = (touches.sum(1) == 2) & border[faces[face, barycentric.argmax(1)]]
    return np.asarray(on_edge | at_vertex)


def crossing_edges(vertices: Floats, faces: Indices, others: Floats, other_faces: Indices) -> int:
    """Number of pairs of an edge of the one mesh and a face of the other that intersect."""
    edges = np.unique(np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    start, end = vertices[edges[:, 0]], vertices[edges[:, 1]]
    corners = others[other_faces]
    centre, middle = corners.mean(1), 0.5 * (start + end)
    radius = float(np.linalg.norm(corners - centre[:, None], axis=2).max())
    half = 0.5 * np.linalg.norm(end - start, axis=1)
    low, high = centre.min(0) - radius, centre.max(0) + radius
    near = ((middle + half[:, None] >= low) & (middle - half[:, None] <= high)).all(1).nonzero()[0]
    found = cKDTree(centre).query_ball_point(middle[near], radius + half[near], return_sorted=False)
    edge = np.repeat(near, [len(each) for each in found])
    if not len(edge):
        return 0
    face = np.concatenate([np.asarray(each, dtype=np.int64) for each in found])
    return int(segments_cross_triangles(start[edge], end[edge], corners[face]).sum())


def segments_cross_triangles(start: Floats, end: Floats, corners: Floats) -> np.ndarray:
    """Whether each segment meets its triangle (Möller and Trumbore 1997), (P,).

    Args:
        start: of the segments (P, 3).
        end: (P, 3).
        corners: of the triangles (P, 3, 3).
    """
    direction = end - start
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    p = np.cross(direction, b)
    determinant = (a * p).sum(1)
    parallel = np.abs(determinant) < 1e-18
    inverse = 1.0 / np.where(parallel, 1.0, determinant)
    s = start - corners[:, 0]
    u = (s * p).sum(1) * inverse
    q = np.cross(s, a)
    v = (direction * q).sum(1) * inverse
    t = (b * q).sum(1) * inverse
    return ~parallel & (u >= 0) & (v >= 0) & (u + v <= 1) & (t >= 0) & (t <= 1)


def triangle_quality(vertices: Floats, faces: Indices) -> Floats:
    """Quality 4√3 A / (a² + b² + c²) of each triangle: 1 equilateral, 0 degenerate; (T,)."""
    p = vertices[faces]
    edges = np.roll(p, -1, 1) - p
    area = 0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    squares = np.maximum((edges**2).sum((1, 2)), 1e-300)
    return np.asarray(4 * np.sqrt(3.0) * area / squares, dtype=np.float64)
