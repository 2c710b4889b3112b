"""What may be added to the incremental potential of a step beside inertia, internal energy and forces."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import NDArray

from toile.physics.implicit.linear_solvers.pattern import BlockPattern

Array = NDArray[np.float64]


class StepPotential(ABC):
    """A potential U(x) of one step of one scene that couples no vertices beyond the Hessian's pattern."""

    @abstractmethod
    def total(self, x: Array, free: Array) -> float:
        """U [J], up to what depends on pinned vertices alone.

        Args:
            x: positions (N, 3) [m].
            free: (N, 3) 1 where a vertex may move, else 0.
        """

    @abstractmethod
    def gradient(self, x: Array) -> Array:
        """Gradient (N, 3) [N]."""

    @abstractmethod
    def add_hessian(self, blocks: Array, pattern: BlockPattern, x: Array, *, convex: bool) -> None:
        """Add the second derivatives.

        Args:
            blocks: (n_blocks, 3, 3) [N/m] in the order of the pattern.
            pattern: of the Hessian.
            x: positions (N, 3) [m].
            convex: without what is indefinite.
        """
