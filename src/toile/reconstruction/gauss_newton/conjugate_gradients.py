"""Conjugate gradients on a dictionary of arrays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Vector = dict[str, Array]


def dot(a: Vector, b: Vector) -> float:
    """Inner product."""
    return float(sum((a[name] * b[name]).sum() for name in a))


def axpy(scale: float, a: Vector, b: Vector) -> Vector:
    """Scale · a + b."""
    return {name: scale * a[name] + b[name] for name in b}


@dataclass(frozen=True)
class Solution:
    """Approximate solution of H s = -g.

    Attributes:
        step: s.
        iterations: how many were taken.
    """

    step: Vector
    iterations: int


def solve(
    hessian: Callable[[Vector], Vector], gradient: Vector, max_iterations: int, tolerance: float
) -> Solution:
    """Solve H s = -g for a positive-definite H until the residual has fallen to ``tolerance`` times |g|."""
    step = {name: np.zeros_like(g) for name, g in gradient.items()}
    residual = {name: -g for name, g in gradient.items()}
    direction = dict(residual)
    squared = first = dot(residual, residual)
    iteration = 0
    while iteration < max_iterations and squared > tolerance**2 * first:
        image = hessian(direction)
        length = squared / dot(direction, image)
        step = axpy(length, direction, step)
        residual = axpy(-length, image, residual)
        previous, squared = squared, dot(residual, residual)
        direction = axpy(squared / previous, direction, residual)
        iteration += 1
    return Solution(step, iteration)
