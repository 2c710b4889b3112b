"""Cleaning a point cloud, and the surface it shows to a camera."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from toile.errors import InputError
from toile.geometry.surface import Floats, TriangleMesh, without_unused_vertices

_FEWEST_POINTS = 200
_NEIGHBOURS = (16, 256)  # of a local fit, whatever the density
_ROUNDS = 3  # of reweighting; enough for isolated outliers


def largest_cluster(points: Floats, *, neighbours: int = 12, tolerance: float = 6.0) -> npt.NDArray[np.bool_]:
    """Which points (N, 3) belong to the one large, evenly dense cluster.

    A point is an outlier if its mean distance to its neighbours exceeds the median by ``tolerance`` median
    deviations; what remains is joined over gaps of up to three typical neighbour distances.
    """
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    distances, _ = cKDTree(points).query(points, k=min(neighbours + 1, len(points)))
    mean = distances[:, 1:].mean(1)
    centre = float(np.median(mean))
    spread = max(float(np.median(np.abs(mean - centre))), 0.05 * centre)
    kept = np.flatnonzero(mean <= centre + tolerance * spread)
    graph = cKDTree(points[kept]).sparse_distance_matrix(
        cKDTree(points[kept]), 3 * centre, output_type="coo_matrix"
    )
    _, label = connected_components(graph, directed=False)
    result = np.zeros(len(points), dtype=bool)
    result[kept[label == np.bincount(label).argmax()]] = True
    return result


def smooth_depth(pixels: Floats, depth: Floats, at: Floats, radius: float) -> tuple[Floats, Floats]:
    """Depth at pixels from scattered noisy samples, by local fits.

    Around each place a quadratic in pixel coordinates is fitted to the inverse depth (exact for planes), by
    least squares with tricube weights and robust reweighting (Cleveland 1979).

    Args:
        pixels: samples (N, 2) [px].
        depth: their depth (N,), positive.
        at: where it is wanted (M, 2) [px].
        radius: of the neighbourhood [px]; widened where there are too few samples.

    Returns:
        Depth (M,), and the distance (M,) [px] to the nearest sample.
    """
    from scipy.spatial import cKDTree

    tree = cKDTree(pixels)
    covered = np.pi * float(np.median(tree.query(pixels, k=min(9, len(pixels)))[0][:, -1])) ** 2 / 8
    count = int(np.clip(np.pi * radius**2 / covered, *_NEIGHBOURS))
    distance, index = tree.query(at, k=min(count, len(pixels)))
    reach = np.maximum(distance[:, -1:], radius) * 1.001
    x, y = np.moveaxis((pixels[index] - at[:, None]) / reach[..., None], -1, 0)
    basis = np.stack((np.ones_like(x), x, y, x * x, x * y, y * y), -1)
    inverse = 1 / depth[index]
    near = (1 - (distance / reach) ** 3) ** 3
    weights = near
    # Where samples lie on one side only, the fit must stay solvable and not bend wildly.
    ridge = np.diag([0.0, 1e-9, 1e-9, 1e-2, 1e-2, 1e-2])
    for _ in range(_ROUNDS):
        weighted = basis * weights[..., None]
        normal = np.einsum("mka,mkb->mab", weighted, basis) + ridge * weights.sum(1)[:, None, None]
        right = np.einsum("mka,mk->ma", weighted, inverse)
        fit = np.linalg.solve(normal, right[..., None])
        residual = np.abs((basis @ fit)[..., 0] - inverse)
        limit = 6 * np.maximum(np.median(residual, axis=1, keepdims=True), 1e-12)
        weights = near * np.clip(1 - (residual / limit) ** 2, 0, None) ** 2
    result: Floats = 1 / fit[:, 0, 0]
    return result, distance[:, 0]


def seen_surface(
    pixels: Floats, positions: Floats, region: npt.NDArray[np.bool_], longest_edge: float, where: str
) -> TriangleMesh:
    """Triangulate points as the camera sees them: Delaunay in the image, one piece.

    Args:
        pixels: (N, 2) [px].
        positions: (N, 3) [m], where each of them is.
        region: (h, w), the pixels the surface may cover.
        longest_edge: triangles with a longer edge [m] bridge a jump in depth and are dropped.
        where: for messages.

    Raises:
        InputError: nothing remains.
    """
    import igl
    from scipy.spatial import Delaunay

    faces = Delaunay(pixels).simplices.astype(np.int64)
    h, w = region.shape
    middle = np.floor(pixels[faces].mean(1)).astype(int)
    inside = region[middle[:, 1].clip(0, h - 1), middle[:, 0].clip(0, w - 1)]
    edges = np.linalg.norm(positions[faces] - positions[np.roll(faces, 1, axis=1)], axis=-1)
    faces = faces[inside & (edges.max(1) <= longest_edge)]
    if len(faces) == 0:
        raise InputError(
            "Point cloud shows no surface inside the mask",
            where=where,
            expected=f"points with neighbours nearer than {longest_edge:.3g} m",
            got="no triangle",
        )
    _, piece = igl.facet_components(np.ascontiguousarray(faces))
    faces = faces[piece == np.bincount(piece).argmax()]
    return without_unused_vertices(positions, _without_pinches(faces))


def require_enough(n: int, where: str, what: str) -> None:
    """Raise InputError if too few points are left to make a surface of."""
    if n < _FEWEST_POINTS:
        expected = f"at least {_FEWEST_POINTS} points on the cloth"
        raise InputError(f"Too few points {what}", where=where, expected=expected, got=str(n))


def _without_pinches(faces: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Drop the smaller fans at vertices where the surface only touches itself."""
    import igl

    while True:
        touching = np.flatnonzero(~igl.is_vertex_manifold(np.ascontiguousarray(faces)))
        pinched = touching[np.isin(touching, faces)]
        if len(pinched) == 0:
            return faces
        faces = faces[~np.isin(faces, pinched).any(1)]
        _, piece = igl.facet_components(np.ascontiguousarray(faces))
        faces = faces[piece == np.bincount(piece).argmax()]
