"""Implicit time integrators, written as a prediction from past positions.

Every method here turns one step into the minimisation of

    Φ(x) = 1 / (2 (β h)²) ‖x - x̂‖²_M + E(x) - <F_ext, x>,      x̂ = Σ_k c_k x_{n-k},

so that Newton's method, the adjoint and the tangents are the same for all of them. Velocities need no
variables of their own: they are differences of past positions.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass


@dataclass(frozen=True)
class Formula:
    """Coefficients of one step from x_n to x_{n+1}.

    Attributes:
        prediction: c_0, c_1, ...: weights of x_n, x_{n-1}, ... in the prediction x̂; they sum to 1.
        velocity: d_0, d_1, ...: h · v_{n+1} = Σ_k d_k x_{n+1-k}; they sum to 0.
        effective_step: β, the implicit fraction of the step.
    """

    prediction: tuple[float, ...]
    velocity: tuple[float, ...]
    effective_step: float


class Integrator(ABC):
    """One implicit method."""

    @property
    @abstractmethod
    def regular(self) -> Formula:
        """The method's own formula."""

    @property
    def starting(self) -> tuple[Formula, ...]:
        """Formulas of the first steps after State.start, with a made-up past; as long as the regular one."""
        return ()

    def formula(self, step: int) -> Formula:
        """Formula of step number ``step`` = 0, 1, ... since State.start."""
        return self.starting[step] if step < len(self.starting) else self.regular

    @property
    def history(self) -> int:
        """Number of past positions that a step needs."""
        return len(self.regular.prediction)


class BackwardEuler(Integrator):
    """First order, strongly damping (paper, Eqs. 2 and 3): x̂ = 2 x_n - x_{n-1}."""

    regular = Formula(prediction=(2.0, -1.0), velocity=(1.0, -1.0), effective_step=1.0)


class BDF2(Integrator):
    """Second-order backward differentiation, L-stable, far less numerical damping at the same cost.

    From x_{n+1} = 4/3 x_n - 1/3 x_{n-1} + 2/3 h v_{n+1}, the same for v, and v eliminated. The first step is
    one of backward Euler and the next two use its velocity, h v_1 = x_1 - x_0. With the regular formula and a
    made-up straight past the velocity would lag by h a / 2 for ever, a being the acceleration at the start: a
    first-order error.
    """

    regular = Formula(
        prediction=(8 / 3, -22 / 9, 8 / 9, -1 / 9), velocity=(1.5, -2.0, 0.5), effective_step=2 / 3
    )
    starting = (
        Formula(prediction=(2.0, -1.0, 0.0, 0.0), velocity=(1.0, -1.0, 0.0), effective_step=1.0),
        Formula((20 / 9, -13 / 9, 2 / 9, 0.0), velocity=(1.5, -2.0, 0.5), effective_step=2 / 3),
        Formula((8 / 3, -7 / 3, 2 / 3, 0.0), velocity=(1.5, -2.0, 0.5), effective_step=2 / 3),
    )
