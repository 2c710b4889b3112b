"""Cholesky factors of matrices that are positive definite up to rounding."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor

Array = NDArray[np.float64]


def positive_lower(matrix: Array) -> Array:
    """Lower triangular factor, zero above; see positive_factor."""
    factor, lower = positive_factor(matrix)
    return np.tril(factor) if lower else np.triu(factor).T


def positive_factor(matrix: Array) -> tuple[Array, bool]:
    """Factor for ``cho_solve``; tangents in single precision may leave small eigenvalues below zero.

    Raises:
        FloatingPointError: the matrix is not finite.
    """
    if not np.isfinite(matrix).all():
        raise FloatingPointError("a Gauss-Newton matrix is not finite")
    matrix = 0.5 * (matrix + matrix.T)
    lift = 0.0
    largest = float(np.diag(matrix).max(initial=1.0))
    while True:
        try:
            factor: tuple[Array, bool] = cho_factor(matrix + lift * np.eye(len(matrix)))
            return factor
        except LinAlgError:
            lift = max(10 * lift, 1e-8 * largest)
