"""The interface of every linear solver."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import NDArray

from toile.physics.implicit.linear_solvers.pattern import BlockPattern

Array = NDArray[np.float64]


class Factor(ABC):
    """Factorised matrix; it stays valid whatever is factorised later."""

    @abstractmethod
    def solve(self, right: Array) -> Array:
        """Solve for (..., N, 3); pinned vertices are ignored on the right and zero in the result."""


class LinearSolver(ABC):
    """Cholesky factorisation of matrices with one pattern; whatever depends on that alone is done once.

    Args:
        pattern: which blocks there are.
        pinned: (n_pinned,) vertices whose rows and columns leave the system.
    """

    def __init__(self, pattern: BlockPattern, pinned: NDArray[np.int64]) -> None:
        self.pattern = pattern
        self.pinned = np.asarray(pinned, np.int64)

    @abstractmethod
    def factorise(self, blocks: Array, diagonal: Array) -> Factor | None:
        """Factor of the blocks plus a multiple of the identity at every vertex, over the free vertices.

        Args:
            blocks: (n_blocks, 3, 3), in the order of the pattern; of diagonal ones only the lower triangle is
                read.
            diagonal: (N,).

        Returns:
            None where the matrix is not positive definite or not finite.
        """
