"""Flattening: a curved sheet laid out in the plane with as little stretching as possible."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from toile.errors import InputError
from toile.geometry.surface import Floats, Indices, TriangleMesh


def flatten(
    mesh: TriangleMesh, border: Indices, where: str, *, iterations: int = 30, tolerance: float = 1e-5
) -> Floats:
    """Plane coordinates (V, 2) of a disc, in its own units, isometric for a developable surface.

    Starts from a conformal map with a free border, or from a map to a circle where that folds, and minimises
    the symmetric Dirichlet energy by SLIM (Rabinovich et al. 2017) with a free border; no triangle is turned
    over on the way.

    Args:
        mesh: a disc.
        border: its border loop.
        where: for messages.
        iterations: of SLIM, at most.
        tolerance: largest move of a vertex in an iteration at which it stops, as a fraction of the diameter.

    Raises:
        InputError: the result overlaps itself.
    """
    import igl

    start: Floats = _start(mesh, border)
    data = igl.slim_precompute(
        np.asfortranarray(mesh.vertices),
        np.asfortranarray(mesh.faces.astype(np.int32)),
        np.asfortranarray(start),
        igl.SYMMETRIC_DIRICHLET,
        np.zeros(0, dtype=np.int32),
        np.asfortranarray(np.zeros((0, 2))),
        0.0,
    )
    flat: Floats = start
    for _ in range(iterations):
        previous, flat = flat, np.ascontiguousarray(igl.slim_solve(data, 1)[:, :2])
        if np.abs(flat - previous).max() <= tolerance * np.ptp(flat):
            break
    _require_single_cover(flat, mesh.faces, border, where)
    return flat


def stretches(mesh: TriangleMesh, flat: Floats) -> Floats:
    """Singular values (T, 2), larger first, of the map from each triangle to the plane; 1 keeps lengths."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    along = b - a
    length = np.linalg.norm(along, axis=1)
    x = along / length[:, None]
    across = c - a
    cx = np.einsum("nk,nk->n", across, x)
    cy = np.linalg.norm(across - cx[:, None] * x, axis=1)
    zero = np.zeros_like(length)
    here = np.stack((np.stack((length, cx), -1), np.stack((zero, cy), -1)), 1)
    p, q, r = (flat[mesh.faces[:, k]] for k in range(3))
    there = np.stack((q - p, r - p), -1)
    return np.asarray(np.linalg.svd(there @ np.linalg.inv(here), compute_uv=False), dtype=np.float64)


def _start(mesh: TriangleMesh, border: Indices) -> Floats:
    """A map without turned triangles, of the mesh's area: the first of three that is one."""
    import igl

    area = float(igl.doublearea(mesh.vertices, mesh.faces).sum()) / 2
    circle = igl.map_vertices_to_circle(np.asfortranarray(mesh.vertices), border.astype(np.int32))
    circle = np.ascontiguousarray(circle)
    starts: tuple[Callable[[], Floats], ...] = (
        lambda: _conformal(mesh, border),
        lambda: igl.harmonic(mesh.vertices, mesh.faces, border, circle, 1),
        lambda: _tutte(mesh, border, circle),
    )
    for make in starts:
        flat = np.ascontiguousarray(make())
        if not np.isfinite(flat).all():
            continue
        if igl.doublearea(flat, mesh.faces).sum() < 0:
            flat[:, 1] *= -1  # the border may be walked either way round
        if not len(igl.flipped_triangles(flat, mesh.faces)):
            break
    covered = float(np.abs(igl.doublearea(flat, mesh.faces)).sum()) / 2
    scaled: Floats = flat * np.sqrt(area / max(covered, 1e-300))
    return scaled


def _conformal(mesh: TriangleMesh, border: Indices) -> Floats:
    """Least-squares conformal map (Lévy et al. 2002), two opposite border vertices fixed."""
    import igl

    ends = np.ascontiguousarray(border[[0, len(border) // 2]])
    apart = float(np.linalg.norm(mesh.vertices[ends[1]] - mesh.vertices[ends[0]]))
    flat, _ = igl.lscm(mesh.vertices, mesh.faces, ends, np.array([[0.0, 0.0], [apart, 0.0]]))
    return np.asarray(flat, dtype=np.float64)


def _tutte(mesh: TriangleMesh, border: Indices, circle: Floats) -> Floats:
    """Every inner vertex at the mean of its neighbours: injective for any disc (Tutte 1963)."""
    import igl
    from scipy.sparse import diags_array
    from scipy.sparse.linalg import spsolve

    adjacency = igl.adjacency_matrix(mesh.faces).astype(np.float64)
    laplacian = (diags_array(np.asarray(adjacency.sum(1)).ravel()) - adjacency).tocsc()
    inner = np.setdiff1d(np.arange(len(mesh.vertices)), border)
    flat = np.zeros((len(mesh.vertices), 2))
    flat[border] = circle
    if len(inner):
        flat[inner] = spsolve(laplacian[inner][:, inner], -laplacian[inner][:, border] @ circle)
    return flat


def _require_single_cover(flat: Floats, faces: Indices, border: Indices, where: str) -> None:
    """No triangle turned over, and the border winds once around the middle of every triangle."""
    import igl

    expected = "a surface that can be laid flat without overlapping itself"
    turned = len(igl.flipped_triangles(flat, faces))
    if turned or not np.isfinite(flat).all():
        raise InputError(
            "Flattened mesh is folded", where=where, expected=expected, got=f"{turned} turned triangles"
        )
    edges = np.column_stack((border, np.roll(border, -1)))
    winding = np.abs(igl.winding_number(flat, edges, np.ascontiguousarray(flat[faces].mean(1))))
    overlapping = int((winding > 1.5).sum())
    if overlapping:
        got = f"{overlapping} of {len(faces)} triangles are covered more than once"
        raise InputError("Flattened mesh overlaps itself", where=where, expected=expected, got=got)
