"""Triangle meshes that are a disc, and points given on them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from toile.errors import InputError
from toile.geometry.io import PolygonMesh

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]


@dataclass(frozen=True)
class TriangleMesh:
    """A triangle mesh.

    Attributes:
        vertices: (V, 3), every one used by a face.
        faces: (T, 3), consistently oriented.
    """

    vertices: Floats
    faces: Indices


@dataclass(frozen=True)
class SurfacePoints:
    """Points on a triangle mesh, whatever is measured there.

    Attributes:
        faces: (N, 3), the vertices of the triangle each point lies in.
        weights: (N, 3), barycentric coordinates.
    """

    faces: Indices
    weights: Floats

    def of(self, values: Floats) -> Floats:
        """Interpolate values (V, k) of the vertices: (N, k)."""
        interpolated: Floats = np.einsum("nc,nck->nk", self.weights, values[self.faces])
        return interpolated


def triangle_mesh(mesh: PolygonMesh, where: str) -> TriangleMesh:
    """Triangles of a polygon mesh: polygons fanned, coincident vertices joined, faces oriented alike.

    Args:
        mesh: any polygon mesh; vertices that no face uses and faces without area are dropped.
        where: its file, for messages.

    Raises:
        InputError: no face, or vertices that are not finite.
    """
    import igl

    expected = "a triangle mesh of finite positions"
    if not mesh.polygons:
        raise InputError("Mesh has no faces", where=where, expected=expected, got="vertices only")
    vertices = mesh.vertices.numpy().astype(np.float64)
    if not np.isfinite(vertices).all():
        n = int((~np.isfinite(vertices)).any(-1).sum())
        raise InputError(
            "Mesh has NaN or infinite positions", where=where, expected=expected, got=f"{n} vertices"
        )
    fans = [(f[0], f[k], f[k + 1]) for f in mesh.polygons for k in range(1, len(f) - 1)]
    # Formats without shared vertices (STL), and texture seams, store the same point several times.
    tolerance = 1e-9 * float(np.ptp(vertices, axis=0).max())
    joined = igl.remove_duplicate_vertices(vertices, np.array(fans, dtype=np.int64), tolerance)
    vertices, faces = joined[0], joined[3]
    faces = faces[igl.doublearea(vertices, faces) > 0]
    if len(faces) == 0:
        raise InputError("Mesh has no area", where=where, expected=expected, got=f"{len(fans)} triangles")
    faces, _ = igl.bfs_orient(np.ascontiguousarray(faces))
    return without_unused_vertices(vertices, faces)


def without_unused_vertices(vertices: Floats, faces: Indices) -> TriangleMesh:
    """The mesh without vertices that belong to no face; the order of the others is kept."""
    used, inverse = np.unique(faces, return_inverse=True)
    return TriangleMesh(
        np.ascontiguousarray(vertices[used]),
        np.ascontiguousarray(inverse.reshape(-1, 3).astype(np.int64)),
    )


def border_of_disc(mesh: TriangleMesh, where: str) -> Indices:
    """The border loop (n,) of a mesh that is one piece without holes, handles or branches.

    Raises:
        InputError: it is not; the message says in which way.
    """
    import igl

    expected = "one connected piece of cloth with one border and no holes"
    pieces, piece_of = igl.facet_components(mesh.faces)
    if pieces != 1:
        sizes = sorted(np.bincount(piece_of).tolist(), reverse=True)
        got = f"{pieces} pieces of {', '.join(map(str, sizes[:5]))} triangles"
        raise InputError("Mesh has more than one component", where=where, expected=expected, got=got)
    if not igl.is_edge_manifold(mesh.faces)[0]:
        raise _no_disc(where, expected, "an edge shared by more than two triangles")
    if not igl.is_vertex_manifold(mesh.faces).all():
        n = int((~igl.is_vertex_manifold(mesh.faces)).sum())
        raise _no_disc(where, expected, f"{n} vertices where the surface only touches itself")
    loops = igl.boundary_loop_all(mesh.faces)
    if len(loops) != 1:
        got = ", ".join(f"{len(loop)}" for loop in sorted(loops, key=len, reverse=True)[:5])
        raise _no_disc(where, expected, f"{len(loops)} borders of {got} vertices" if loops else "no border")
    if igl.euler_characteristic(mesh.faces) != 1:
        got = f"one border, but Euler characteristic {igl.euler_characteristic(mesh.faces)} (a handle)"
        raise _no_disc(where, expected, got)
    return np.array(loops[0], dtype=np.int64)


def at_vertices(mesh: TriangleMesh, vertices: Indices) -> SurfacePoints:
    """Vertices (N,) of a mesh as points on it."""
    face_of = np.empty(len(mesh.vertices), dtype=np.int64)
    for corner in range(3):
        face_of[mesh.faces[:, corner]] = np.arange(len(mesh.faces))
    faces = mesh.faces[face_of[vertices]]
    return SurfacePoints(faces, (faces == vertices[:, None]).astype(np.float64))


def nearest_points(points: Floats, vertices: Floats, faces: Indices) -> tuple[SurfacePoints, Floats]:
    """The nearest points on a mesh (vertices (V, d), d = 2 or 3) to points (N, d), and the distances (N,)."""
    import igl

    p, v = _in_space(points), _in_space(vertices)
    squared, index, closest = igl.point_mesh_squared_distance(p, v, faces)
    near = np.ascontiguousarray(faces[index])
    weights = igl.barycentric_coordinates(
        np.ascontiguousarray(closest), *(np.ascontiguousarray(v[near[:, k]]) for k in range(3))
    )
    return SurfacePoints(near, weights), np.sqrt(squared)


def _in_space(points: Floats) -> Floats:
    """Plane points with a third coordinate of zero, which is what libigl takes."""
    p = points if points.shape[1] == 3 else np.column_stack((points, np.zeros(len(points))))
    return np.ascontiguousarray(p, dtype=np.float64)


def _no_disc(where: str, expected: str, got: str) -> InputError:
    return InputError("Mesh is not a disc", where=where, expected=expected, got=got)
