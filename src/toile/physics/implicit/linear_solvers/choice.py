"""Which solver a pattern gets."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from toile.physics.implicit.linear_solvers.banded import BandedSolver
from toile.physics.implicit.linear_solvers.base import LinearSolver
from toile.physics.implicit.linear_solvers.pattern import BlockPattern


def chosen_solver(pattern: BlockPattern, pinned: NDArray[np.int64]) -> LinearSolver:
    """The solver of least cost."""
    return BandedSolver(pattern, pinned)
