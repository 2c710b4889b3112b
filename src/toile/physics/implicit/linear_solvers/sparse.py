"""Sparse Cholesky factorisation: multifrontal, on supernodes from nested dissection; see ``analysis``."""

from __future__ import annotations

import numpy as np
import warp as wp
from numpy.typing import NDArray

from toile.physics.implicit.linear_solvers import sparse_kernels
from toile.physics.implicit.linear_solvers.analysis import analyse
from toile.physics.implicit.linear_solvers.base import Factor, LinearSolver
from toile.physics.implicit.linear_solvers.pattern import BlockPattern
from toile.warp_runtime import view

Array = NDArray[np.float64]


class SparseFactor(Factor):
    """See Factor.

    Attributes:
        solver: that has made it.
        values: of L, panel after panel.
    """

    def __init__(self, solver: SparseSolver, values: Array) -> None:
        self.solver, self.values = solver, values

    def solve(self, right: Array) -> Array:
        """See Factor."""
        analysis = self.solver.analysis
        many = right.reshape(-1, *right.shape[-2:])
        x = np.ascontiguousarray(many[:, analysis.order], np.float64)
        work = np.empty(len(many) * analysis.n_below)
        arrays = [view(a.reshape(-1), wp.float64) for a in (self.values, x, work)]
        wp.launch(sparse_kernels.solve, dim=1, inputs=[analysis.supernodes, len(many), *arrays], device="cpu")
        found = np.zeros(many.shape)
        found[:, analysis.order] = x
        return found.reshape(right.shape)


class SparseSolver(LinearSolver):
    """Multifrontal Cholesky factorisation: the fastest for wide and large cloths.

    Attributes:
        analysis: shared by all solvers of the same pattern and pinned vertices.
    """

    def __init__(self, pattern: BlockPattern, pinned: NDArray[np.int64]) -> None:
        super().__init__(pattern, pinned)
        self.analysis = analyse(pattern, self.pinned)

    def __reduce__(self) -> tuple[object, ...]:
        """What the kernels know stays in its process."""
        return (SparseSolver, (self.pattern, self.pinned))

    def factorise(self, blocks: Array, diagonal: Array) -> SparseFactor | None:
        """See LinearSolver."""
        values, work = np.empty(self.analysis.n_values), np.empty(self.analysis.n_work)
        definite = np.zeros(1, np.int32)
        given = [np.ascontiguousarray(a, np.float64).reshape(-1) for a in (blocks, diagonal)]
        arrays = [view(a, wp.float64) for a in (*given, values, work)]
        wp.launch(
            sparse_kernels.factorise,
            dim=1,
            inputs=[self.analysis.supernodes, *arrays, view(definite, wp.int32)],
            device="cpu",
        )
        return SparseFactor(self, values) if definite[0] else None
