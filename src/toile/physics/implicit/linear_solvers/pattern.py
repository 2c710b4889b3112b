"""Which vertices a symmetric matrix of 3×3 blocks couples."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Indices = NDArray[np.int64]


@dataclass(frozen=True)
class BlockPattern:
    """Places of the blocks of the lower triangle, sorted by row and then by column.

    Attributes:
        n_vertices: N.
        rows, columns: (n_blocks,) vertices, row >= column; every diagonal block is there.
    """

    n_vertices: int
    rows: Indices
    columns: Indices

    @staticmethod
    def of_pairs(n_vertices: int, pairs: Indices) -> BlockPattern:
        """From coupled vertices (P, 2), in any order and as often as one likes."""
        keys = np.unique(pairs.max(1) * n_vertices + pairs.min(1))
        keys = np.union1d(keys, np.arange(n_vertices) * (n_vertices + 1))
        return BlockPattern(n_vertices, keys // n_vertices, keys % n_vertices)

    @cached_property
    def _keys(self) -> Indices:
        return self.rows * self.n_vertices + self.columns

    @cached_property
    def diagonal(self) -> Indices:
        """Places of the diagonal blocks, (N,)."""
        return np.searchsorted(self._keys, np.arange(self.n_vertices) * (self.n_vertices + 1))

    def slots(self, p: Indices, q: Indices) -> tuple[Indices, NDArray[np.bool_]]:
        """Place of the block of each pair (p, q), and whether its transpose, that of (q, p), is stored."""
        key = np.maximum(p, q) * self.n_vertices + np.minimum(p, q)
        place = np.searchsorted(self._keys, key).clip(max=len(self._keys) - 1)
        if (self._keys[place] != key).any():
            raise ValueError("slots: expected pairs of the pattern, got others")
        return place, p < q
