"""Cross-sections of a body as convex outlines, and rings of points along them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull

from toile.errors import InputError

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

_ANGLES = np.linspace(0, 2 * np.pi, 192, endpoint=False)

DIRECTIONS: Floats = np.stack((np.cos(_ANGLES), np.sin(_ANGLES)), 1)
"""In which support functions are known, (D, 2) in (x, z), counter-clockwise."""


def plane_section(vertices: Floats, faces: Indices, normal: Floats, offset: float) -> Floats:
    """Ends of the segments in which a plane cuts the triangles of a mesh.

    Args:
        vertices: (V, 3).
        faces: (T, 3).
        normal: of the plane {x: normal · x = offset}, (3,).
        offset: see ``normal``.

    Returns:
        (S, 2, 3).
    """
    height = vertices @ normal - offset
    # A vertex exactly on the plane counts as above: no triangle is cut in one point only.
    above = height >= 0
    cut = faces[above[faces].any(1) & ~above[faces].all(1)]
    segments = []
    for corner in range(3):
        a, b = cut[:, corner], cut[:, (corner + 1) % 3]
        crosses = above[a] != above[b]
        difference = np.where(crosses, height[a] - height[b], 1.0)
        t = (height[a] / difference)[:, None]
        segments.append(np.where(crosses[:, None], vertices[a] + t * (vertices[b] - vertices[a]), np.nan))
    points = np.stack(segments, 1)
    return points[~np.isnan(points[..., 0])].reshape(-1, 2, 3)


def section_support(vertices: Floats, faces: Indices, height: float) -> Floats:
    """Support function of a horizontal section: how far it reaches in each of ``DIRECTIONS``.

    The support function of a convex hull is that of its points; of the hull of two sets it is the larger one,
    and of what lies within a distance of a set it is larger by the distance.

    Args:
        vertices: (V, 3) [m].
        faces: (T, 3).
        height: y of the section [m].

    Returns:
        (D,) [m].

    Raises:
        InputError: the plane misses the mesh.
    """
    points = plane_section(vertices, faces, np.array([0.0, 1.0, 0.0]), height).reshape(-1, 3)[:, [0, 2]]
    if len(points) < 3:
        raise InputError(
            "Garment reaches beyond the body",
            where="garment",
            expected=f"heights from {vertices[:, 1].min():.2f} to {vertices[:, 1].max():.2f} m",
            got=f"{height:.2f} m",
        )
    return np.asarray((points @ DIRECTIONS.T).max(0), dtype=np.float64)


def outline(support: Floats) -> Floats:
    """Convex outline of a support function: corners (D, 2) in (x, z), counter-clockwise.

    Each corner is where the supporting lines of two successive directions meet, so that the outline lies
    around the set, by 0.1 mm at most for a skirt.
    """
    n, m = DIRECTIONS, np.roll(DIRECTIONS, -1, 0)
    h, k = support, np.roll(support, -1)
    determinant = n[:, 0] * m[:, 1] - n[:, 1] * m[:, 0]
    x, z = (h * m[:, 1] - k * n[:, 1]) / determinant, (k * n[:, 0] - h * m[:, 0]) / determinant
    return np.stack((x, z), 1)


def hull(points: Floats) -> Floats:
    """Corners of the convex hull of points in the plane, (P, 2), counter-clockwise."""
    return points[ConvexHull(points).vertices]


def grown(points: Floats, distance: float) -> Floats:
    """Convex hull of discs of a radius around points: the outline at that distance."""
    return points if distance <= 0 else hull((points[:, None] + distance * DIRECTIONS[::3]).reshape(-1, 2))


def length_of(polygon: Floats) -> float:
    """Circumference of a closed polygon."""
    return float(np.linalg.norm(np.roll(polygon, -1, 0) - polygon, axis=1).sum())


def ring(polygon: Floats, count: int, shift: float) -> tuple[Floats, Floats]:
    """Points at equal distances along a convex outline around the origin.

    Args:
        polygon: (P, 2), (x, z), counter-clockwise.
        count: of points.
        shift: of the first point from where the outline crosses the half-axis +z, in steps.

    Returns:
        Points (count, 2), and where they are as shares of the circumference, counted from there.
    """
    polygon = _from_front(polygon)
    closed = np.concatenate((polygon, polygon[:1]))
    lengths = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))))
    share = (np.arange(count) + shift) / count
    at = (share % 1.0) * lengths[-1]
    return np.stack([np.interp(at, lengths, closed[:, axis]) for axis in range(2)], 1), share


def _from_front(polygon: Floats) -> Floats:
    """The same outline, beginning where it crosses the half-axis +z."""
    a, b = polygon, np.roll(polygon, -1, 0)
    # A convex outline that is walked around counter-clockwise passes from +x to −x once: in front.
    crossing = np.flatnonzero((a[:, 0] > 0) & (b[:, 0] <= 0))
    if len(crossing) != 1:
        raise InputError(
            "Section of the body does not surround its middle",
            where="garment",
            expected="a body that stands upright, with x = 0 inside its trunk",
            got=f"an outline from x = {a[:, 0].min():.3f} to {a[:, 0].max():.3f} m",
        )
    first = int(crossing[0])
    t = a[first, 0] / (a[first, 0] - b[first, 0])
    start = a[first] + t * (b[first] - a[first])
    return np.concatenate((start[None], np.roll(polygon, -(first + 1), 0)))
