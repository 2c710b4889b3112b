"""Tubes of near-equilateral triangles through a stack of convex outlines."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from toile.capture.garments.sections import Floats, Indices, length_of, ring

Outline = Callable[[float], Floats]
"""Outline (P, 2) in (x, z) at a height."""


@dataclass(frozen=True)
class Tube:
    """A tube around the body.

    Attributes:
        vertices: (N, 3) [m], ring after ring from the top.
        faces: (T, 3), normals outward.
        rings: index of the ring of each vertex (N,).
        starts: index of the first vertex of each ring, and N.
    """

    vertices: Floats
    faces: Indices
    rings: Indices
    starts: Indices


def tube(outlines: list[Floats], heights: Floats, spacing: float) -> Tube:
    """Rings of points ``spacing`` apart on given outlines, joined by triangles.

    Every ring has as many points as fit, so that triangles are of one size where a skirt widens; there is no
    seam. Successive rings are shifted by half a step.

    Args:
        outlines: one polygon a ring, from the top.
        heights: of the rings [m].
        spacing: of the points [m].
    """
    counts = [max(6, round(length_of(polygon) / spacing)) for polygon in outlines]
    # A ring that is a point or two longer than the one above takes its number: fewer irregular vertices.
    points, shares = [], []
    for k, (polygon, count, height) in enumerate(zip(outlines, counts, heights, strict=True)):
        flat, share = ring(polygon, count, 0.5 * (k % 2))
        points.append(np.stack((flat[:, 0], np.full(count, height), flat[:, 1]), 1))
        shares.append(share)
    starts = np.concatenate(([0], np.cumsum(counts)))
    faces = [
        strip(points[k], points[k + 1], shares[k], shares[k + 1], starts[k], starts[k + 1])
        for k in range(len(points) - 1)
    ]
    rings = np.repeat(np.arange(len(counts)), counts)
    return Tube(np.concatenate(points), np.concatenate(faces), rings, starts)


def strip(
    upper: Floats, lower: Floats, upper_share: Floats, lower_share: Floats, first_upper: int, first_lower: int
) -> Indices:
    """Triangles between two closed rings, by walking around both and always closing the shorter diagonal.

    Args:
        upper: (n, 3).
        lower: (m, 3).
        upper_share: where the points are along the ring (n,), of its circumference.
        lower_share: (m,).
        first_upper: index of the first vertex of the upper ring.
        first_lower: of the lower one.
    """
    n, m = len(upper), len(lower)
    i = j = 0
    faces = []
    while i < n or j < m:
        next_upper = upper_share[(i + 1) % n] + (i + 1) // n
        next_lower = lower_share[(j + 1) % m] + (j + 1) // m
        a, b = upper[i % n], lower[j % m]
        along_upper = float(np.linalg.norm(upper[(i + 1) % n] - b))
        along_lower = float(np.linalg.norm(lower[(j + 1) % m] - a))
        step_upper = along_upper < along_lower
        # One ring may not run ahead of the other by more than a step: the strip would be twisted.
        if next_upper > next_lower + 1.0 / m:
            step_upper = False
        elif next_lower > next_upper + 1.0 / n:
            step_upper = True
        if j >= m or (i < n and step_upper):
            faces.append((first_upper + i % n, first_upper + (i + 1) % n, first_lower + j % m))
            i += 1
        else:
            faces.append((first_upper + i % n, first_lower + (j + 1) % m, first_lower + j % m))
            j += 1
    return np.array(faces, dtype=np.int64)
