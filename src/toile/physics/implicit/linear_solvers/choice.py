"""Which solver a pattern gets: the one that is predicted to be faster.

Predicted is the time of one factorisation and three solves, about what a Newton iteration takes, from the
work that each solver has to do. The rates are fits to times measured on one core; nothing is timed when a
cloth is made, so that the choice is always the same. How well they predict: ``benchmarks/linear_solvers.py``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from toile.physics.implicit.linear_solvers.analysis import SymbolicAnalysis
from toile.physics.implicit.linear_solvers.banded import BandedSolver
from toile.physics.implicit.linear_solvers.base import LinearSolver
from toile.physics.implicit.linear_solvers.pattern import BlockPattern
from toile.physics.implicit.linear_solvers.sparse import SparseSolver

# Seconds per unit of work.
_BAND_PRODUCT, _BAND_ENTRY = 2.8e-11, 8.1e-9
_SPARSE_FLOP, _SUPERNODE = 5.9e-11, 3.2e-5
# No cloth takes the sparse solver less than this per vertex [s]; where the band is as fast, none is analysed.
_SPARSE_LEAST = 3.5e-6
# How many times faster the sparse solver has to be. Grids of up to 63×63 vertices, which published results
# and generated scenes were made with, stay with the band and keep their last digits; this is all they lose.
_GAIN = 2.5


def banded_seconds(solver: BandedSolver) -> float:
    """Predicted time of the banded solver: the work is n b² products, and n b entries are moved."""
    n, b = 3 * solver.pattern.n_vertices, solver.half_bandwidth
    return _BAND_PRODUCT * n * b**2 + _BAND_ENTRY * n * b


def sparse_seconds(analysis: SymbolicAnalysis) -> float:
    """Predicted time of the sparse solver."""
    return _SPARSE_FLOP * analysis.flops + _SUPERNODE * analysis.n_supernodes


def chosen_solver(pattern: BlockPattern, pinned: NDArray[np.int64]) -> LinearSolver:
    """The sparse solver where it is predicted to be faster by far, else the banded one."""
    banded = BandedSolver(pattern, pinned)
    enough = banded_seconds(banded) / _GAIN
    if enough <= _SPARSE_LEAST * (pattern.n_vertices - len(banded.pinned)):
        return banded
    sparse = SparseSolver(pattern, pinned)
    return sparse if sparse_seconds(sparse.analysis) < enough else banded
