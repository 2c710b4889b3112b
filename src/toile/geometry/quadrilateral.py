"""Four corners of an outline, their names in an image, and grids stretched between four sides."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from toile.errors import InputError
from toile.geometry.surface import Floats

CORNERS = ("upper left", "upper right", "lower right", "lower left")
"""Order of the corners of a grid: clockwise as the camera sees them, from vertex [0, 0] on."""
SideFit = Callable[[Floats, int], Floats]
"""Makes n points, equally spaced along it, of a side given as a polyline (m, 2) between two corners."""

_MOST_HULL_POINTS = 240
_LEAST_FILL = 0.85  # of the outline's area by its quadrilateral; a circle reaches 0.64, a triangle 0.5
_ANGLES = (45.0, 135.0)  # degrees, that cloth corners have


def four_corners(outline: Floats, where: str) -> tuple[int, int, int, int]:
    """The four corners of a closed outline (n, 2): the inscribed quadrilateral of largest area.

    Returns:
        Their indices, increasing.

    Raises:
        InputError: the outline has no four corners (a circle, a triangle, a ragged blob).
    """
    from scipy.spatial import ConvexHull

    hull = np.sort(ConvexHull(outline).vertices)
    if len(hull) > _MOST_HULL_POINTS:
        hull = hull[np.linspace(0, len(hull) - 1, _MOST_HULL_POINTS).round().astype(int)]
    if len(hull) < 4:
        raise _no_four_corners(where, f"a convex hull of {len(hull)} points")
    points, n = outline[hull], len(hull)
    best, corners = -1.0, (0, 0, 0, 0)
    for a in range(n - 2):
        # Twice the area of the triangles (a, c, k), by c (rows) and k (columns).
        to = points - points[a]
        area = np.abs(to[:, None, 0] * to[None, :, 1] - to[:, None, 1] * to[None, :, 0])
        for c in range(a + 2, n):
            b = a + 1 + int(area[c, a + 1 : c].argmax())
            rest = np.r_[c + 1 : n, 0:a]
            if len(rest) == 0:
                continue
            d = int(rest[area[c, rest].argmax()])
            if area[c, b] + area[c, d] > best:
                best = float(area[c, b] + area[c, d])
                corners = (a, b, c, d)
    found = sorted(int(hull[k]) for k in corners)
    require_quadrilateral(outline, found, where)
    return found[0], found[1], found[2], found[3]


def require_quadrilateral(outline: Floats, corners: Sequence[int], where: str) -> None:
    """Raise InputError unless four corners, in order, make an outline (n, 2) a plausible quadrilateral."""
    quad = outline[list(corners)]
    if np.linalg.norm(quad - np.roll(quad, 1, 0), axis=1).min() == 0:
        raise _no_four_corners(where, "two corners at the same place")
    fill = abs(signed_area(quad)) / abs(signed_area(outline))
    angles = _angles(quad)
    if fill < _LEAST_FILL or fill > 1 / _LEAST_FILL or angles.min() < _ANGLES[0] or angles.max() > _ANGLES[1]:
        listed = ", ".join(f"{angle:.0f}" for angle in angles)
        raise _no_four_corners(
            where, f"angles of {listed} degrees; they span {100 * fill:.0f} % of the outline's area"
        )


def signed_area(polygon: Floats) -> float:
    """Area of a polygon (n, 2); positive if clockwise as seen in an image, whose y runs down."""
    x, y = polygon.T
    return float(0.5 * (x * np.roll(y, -1) - np.roll(x, -1) * y).sum())


def named_corners(pixels: Floats) -> tuple[int, int, int, int]:
    """Which of four corners (4, 2) [px], in cyclic order, is which, in the order of CORNERS.

    The upper side is the one whose middle is highest in the image; its left end is the upper left corner.
    """
    order = list(range(4))
    if signed_area(pixels) < 0:
        order.reverse()
    p = pixels[order]
    first = int((p[:, 1] + np.roll(p[:, 1], -1)).argmin())
    order = order[first:] + order[:first]
    return order[0], order[1], order[2], order[3]


def sides(outline: Floats, corners: Sequence[int]) -> tuple[Floats, Floats, Floats, Floats]:
    """The polylines of an outline (n, 2) from each of four corners to the next, whichever way it runs.

    Args:
        outline: closed.
        corners: four indices that follow each other along the outline, forwards or backwards.
    """
    n = len(outline)
    forwards = sum((corners[(k + 1) % 4] - corners[k]) % n for k in range(4)) == n
    step = 1 if forwards else -1
    found = []
    for k in range(4):
        a, b = corners[k], corners[(k + 1) % 4]
        count = (step * (b - a)) % n
        found.append(outline[(a + step * np.arange(count + 1)) % n])
    return found[0], found[1], found[2], found[3]


def exact_side(side: Floats, n: int) -> Floats:
    """Points on the side itself, however ragged it is."""
    along = np.r_[0.0, np.linalg.norm(np.diff(side, axis=0), axis=1).cumsum()]
    at = np.linspace(0, along[-1], n)
    return np.column_stack([np.interp(at, along, side[:, k]) for k in range(2)])


def smooth_side(side: Floats, n: int, degree: int = 8) -> Floats:
    """Points on the polynomial through both corners that is nearest to the side (robust least squares).

    For outlines taken from pixels, whose steps, loose threads and dents are not the cloth's. A side that
    turns back on its chord is no such function; then the points lie on the side itself.
    """
    from scipy.optimize import least_squares

    chord = side[-1] - side[0]
    length = float(np.linalg.norm(chord))
    x = (side - side[0]) @ chord / length**2
    y = ((side - side[0]) @ np.array([-chord[1], chord[0]])) / length**2
    if len(side) < 2 * degree or x.min() < -0.2 or x.max() > 1.2:
        return exact_side(side, n)
    basis = _bows(x, degree)
    scale = max(float(np.abs(y).mean()), 1e-9)
    fit = least_squares(lambda c: basis @ c - y, np.zeros(degree - 1), loss="soft_l1", f_scale=scale)
    t = np.linspace(0, 1, 20 * n)
    bow = _bows(t, degree) @ fit.x
    curve = side[0] + t[:, None] * chord + bow[:, None] * np.array([-chord[1], chord[0]])
    return exact_side(curve, n)


def _bows(x: Floats, degree: int) -> Floats:
    """Polynomials (n, degree - 1) that vanish at 0 and 1: Legendre's times x (1 - x)."""
    legendre = np.polynomial.legendre.legvander(2 * x - 1, degree - 2)
    return np.asarray((x * (1 - x))[:, None] * legendre, dtype=np.float64)


def grid_between(quad: tuple[Floats, Floats, Floats, Floats], shape: tuple[int, int], fit: SideFit) -> Floats:
    """A grid (H, W, 2) whose borders are four sides: Coons's patch (1967).

    Args:
        quad: sides upper, right, lower and left, each from one corner to the next clockwise.
        shape: (H, W); axis 0 runs along the upper side, axis 1 down the left one.
        fit: exact_side or smooth_side.
    """
    H, W = shape
    upper, right = fit(quad[0], H), fit(quad[1], W)
    lower, left = fit(quad[2], H)[::-1], fit(quad[3], W)[::-1]
    s, t = np.linspace(0, 1, H)[:, None, None], np.linspace(0, 1, W)[None, :, None]
    ruled = (1 - t) * upper[:, None] + t * lower[:, None] + (1 - s) * left[None] + s * right[None]
    corners = (1 - t) * ((1 - s) * upper[0] + s * upper[-1]) + t * ((1 - s) * lower[0] + s * lower[-1])
    grid: Floats = ruled - corners
    return grid


def _angles(quad: Floats) -> Floats:
    """Inner angles of a quadrilateral (4, 2) [degrees]."""
    a, b = np.roll(quad, 1, 0) - quad, np.roll(quad, -1, 0) - quad
    cosine = (a * b).sum(1) / (np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1))
    degrees: Floats = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    return degrees


def _no_four_corners(where: str, got: str) -> InputError:
    return InputError(
        "Outline has not four corners",
        where=where,
        expected="the outline of a rectangular cloth, or corners=[[x, y], ...] given by hand",
        got=got,
    )
