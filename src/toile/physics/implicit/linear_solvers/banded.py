"""Banded Cholesky factorisation through LAPACK, called without the interpreter lock.

Measured on a grid of 32×32 vertices (3072 unknowns, half bandwidth 194; one core): dpbtrf takes 3 ms and a
solve 0.13 ms. See docs/results/linear_solvers.md for the alternatives.
"""

from __future__ import annotations

import ctypes

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import reverse_cuthill_mckee

from toile.physics.implicit.linear_solvers.base import Factor, LinearSolver
from toile.physics.implicit.linear_solvers.fortran import routine
from toile.physics.implicit.linear_solvers.pattern import BlockPattern

Array = NDArray[np.float64]


_pbtrf = routine("dpbtrf", 6)
_pbtrs = routine("dpbtrs", 9)


def bandwidth_order(n_vertices: int, pairs: NDArray[np.int64]) -> tuple[NDArray[np.int64], int]:
    """Vertex order with a small bandwidth: reverse Cuthill–McKee, or the given one where it is as good.

    Args:
        n_vertices: N.
        pairs: (P, 2) coupled vertices.

    Returns:
        position (N,) of every vertex in the new order, and the vertex half bandwidth.
    """
    natural = int(np.abs(pairs[:, 0] - pairs[:, 1]).max(initial=0))
    graph = coo_array(
        (np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(n_vertices, n_vertices)
    ).tocsr()
    order = reverse_cuthill_mckee((graph + graph.T).tocsr(), symmetric_mode=True)
    position = np.empty(n_vertices, np.int64)
    position[order] = np.arange(n_vertices)
    reordered = int(np.abs(position[pairs[:, 0]] - position[pairs[:, 1]]).max(initial=0))
    if reordered < natural:
        return position, reordered
    return np.arange(n_vertices), natural


class BandedCholesky:
    """Factor of a symmetric positive-definite matrix in LAPACK's lower band storage.

    Attributes:
        band: (n, b + 1) row k holds column k of the lower triangle from the diagonal down.
    """

    def __init__(self, band: Array) -> None:
        self.band = band
        self.n = band.shape[0]

    @staticmethod
    def factorise(band: Array) -> BandedCholesky | None:
        """Factorise in place; None where the matrix is not positive definite or not finite."""
        n = ctypes.c_int(band.shape[0])
        kd = ctypes.c_int(band.shape[1] - 1)
        ldab = ctypes.c_int(band.shape[1])
        info = ctypes.c_int(0)
        _pbtrf(
            b"L", ctypes.byref(n), ctypes.byref(kd), band.ctypes.data, ctypes.byref(ldab), ctypes.byref(info)
        )
        # LAPACK lets NaN pass as positive; it reaches the diagonal wherever it was.
        definite = info.value == 0 and bool(np.isfinite(band[:, 0]).all())
        return BandedCholesky(band) if definite else None

    def solve(self, right: Array) -> Array:
        """Solve for right-hand sides (..., n); returns the same shape."""
        x = np.array(right, dtype=np.float64, order="C")
        n = ctypes.c_int(self.n)
        kd = ctypes.c_int(self.band.shape[1] - 1)
        nrhs = ctypes.c_int(x.size // self.n)
        ldab = ctypes.c_int(self.band.shape[1])
        info = ctypes.c_int(0)
        _pbtrs(
            b"L",
            ctypes.byref(n),
            ctypes.byref(kd),
            ctypes.byref(nrhs),
            self.band.ctypes.data,
            ctypes.byref(ldab),
            x.ctypes.data,
            ctypes.byref(n),
            ctypes.byref(info),
        )
        return x


class BandedFactor(Factor):
    """See Factor.

    Attributes:
        cholesky: of the band.
        order: (3N,) unknown of the band that each coordinate of each vertex is.
        free: (N, 3) 1 where a vertex may move, else 0.
    """

    def __init__(self, cholesky: BandedCholesky, order: NDArray[np.int64] | None, free: Array) -> None:
        self.cholesky, self.order, self.free = cholesky, order, free

    def solve(self, right: Array) -> Array:
        """See Factor."""
        flat = (right * self.free).reshape(*right.shape[:-2], self.free.size)
        if self.order is not None:
            flat, own = np.empty_like(flat), flat
            flat[..., self.order] = own
        found = self.cholesky.solve(flat)
        if self.order is not None:
            found = found[..., self.order]
        return found.reshape(right.shape)


class BandedSolver(LinearSolver):
    """Band storage after a reduction of the bandwidth: the fastest for narrow sheets.

    Attributes:
        half_bandwidth: of the unknowns.
    """

    def __init__(self, pattern: BlockPattern, pinned: NDArray[np.int64]) -> None:
        super().__init__(pattern, pinned)
        n = pattern.n_vertices
        position, half = bandwidth_order(n, np.column_stack((pattern.rows, pattern.columns)))
        self.half_bandwidth = 3 * half + 2
        self.order = (3 * position[:, None] + np.arange(3)).reshape(-1)
        self._natural = bool((position == np.arange(n)).all())
        self.free = np.ones((n, 3))
        self.free[self.pinned] = 0.0
        self._pinned_unknowns = (3 * position[self.pinned][:, None] + np.arange(3)).reshape(-1)
        is_free = self.free[:, 0] > 0
        kept = np.flatnonzero(is_free[pattern.rows] & is_free[pattern.columns])
        row, column = position[pattern.rows[kept]], position[pattern.columns[kept]]
        r = np.broadcast_to(3 * row[:, None, None] + np.arange(3)[:, None], (len(kept), 3, 3))
        c = np.broadcast_to(3 * column[:, None, None] + np.arange(3), (len(kept), 3, 3))
        # A block above the band's diagonal is stored as its transpose; of a diagonal block one half is.
        lower, upper = np.maximum(r, c), np.minimum(r, c)
        stored = (row != column)[:, None, None] | (r >= c)
        source = (9 * kept[:, None] + np.arange(9)).reshape(-1, 3, 3)
        self._source = source[stored]
        self._target = (upper * (self.half_bandwidth + 1) + lower - upper)[stored]

    def factorise(self, blocks: Array, diagonal: Array) -> BandedFactor | None:
        """See LinearSolver."""
        cholesky = BandedCholesky.factorise(self.band(blocks, diagonal))
        if cholesky is None:
            return None
        return BandedFactor(cholesky, None if self._natural else self.order, self.free)

    def band(self, blocks: Array, diagonal: Array) -> Array:
        """The matrix in LAPACK's lower band storage, (3N, b + 1); 1 on the diagonal of pinned vertices."""
        band = np.zeros((3 * self.pattern.n_vertices, self.half_bandwidth + 1))
        band.reshape(-1)[self._target] = blocks.reshape(-1)[self._source]
        band[self.order, 0] += (diagonal[:, None] * self.free).reshape(-1)
        band[self._pinned_unknowns, 0] = 1.0
        return band
