"""The interface every simulator implements."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from enum import Enum
from typing import Any

from torch import Tensor

from toile.physics.material import Material
from toile.physics.state import State


class StepStatus(Enum):
    """How a step ended."""

    CONVERGED = "converged"
    MAX_ITERATIONS = "the iteration limit was reached before the residual fell below the tolerance"
    LINE_SEARCH_FAILED = "no step length lowered the incremental potential"
    NOT_FINITE = "positions or forces are not finite"


class SimulationError(RuntimeError):
    """A step failed; the message says which frame, why, and what to try."""


@dataclass(frozen=True)
class StepResult:
    """Outcome of one time step.

    Attributes:
        state: the new state.
        status: one per scene of the batch.
        iterations: Newton iterations, one per scene (0 for simulators without any).
        residual: largest out-of-balance force per scene [N].
        linearization: derivatives kept on request, one per scene; opaque to everything but the adjoint.
    """

    state: State
    status: tuple[StepStatus, ...]
    iterations: tuple[int, ...]
    residual: tuple[float, ...]
    linearization: tuple[Any, ...] = ()


class Simulator(ABC):
    """Advances cloths by one time step; differentiable in every tensor argument."""

    time_step: float
    n_past: int

    @abstractmethod
    def step(
        self,
        state: State,
        material: Material,
        forces: Tensor,
        boundary: Tensor,
        guess: Tensor | None = None,
        *,
        linearize: bool = False,
    ) -> StepResult:
        """Advance by ``time_step``.

        Args:
            state: at time n.
            material: stiffnesses, (B,) each.
            forces: external force on every vertex at time n + 1, gravity included, (B, N, 3) [N].
            boundary: positions of the pinned vertices at time n + 1, (B, n_pinned, 3) [m].
            guess: warm start for the new positions, (B, N, 3) [m].
            linearize: keep what LinearizedRollout needs.
        """
