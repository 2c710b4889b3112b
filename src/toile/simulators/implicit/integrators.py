"""Implicit time integrators, written as a prediction from past positions.

Every method here turns one step into the minimisation of

    Φ(x) = 1 / (2 (β h)²) ‖x - x̂‖²_M + E(x) - <F_ext, x>,      x̂ = Σ_k c_k x_{n-k},

so that Newton's method, the adjoint and the tangents are the same for all of them. Velocities need no
variables of their own: they are differences of past positions.
"""

from __future__ import annotations

from abc import ABC, abstractmethod


class Integrator(ABC):
    """Coefficients of one implicit method."""

    @property
    @abstractmethod
    def prediction(self) -> tuple[float, ...]:
        """c_0, c_1, ...: weights of x_n, x_{n-1}, ... in the prediction x̂; they sum to 1."""

    @property
    @abstractmethod
    def velocity(self) -> tuple[float, ...]:
        """d_0, d_1, ...: h · v_n = Σ_k d_k x_{n-k}; they sum to 0."""

    @property
    @abstractmethod
    def effective_step(self) -> float:
        """β, the implicit fraction of the step."""

    @property
    def history(self) -> int:
        """Number of past positions that a step needs."""
        return len(self.prediction)


class BackwardEuler(Integrator):
    """First order, strongly damping (paper, Eqs. 2 and 3): x̂ = 2 x_n - x_{n-1}."""

    prediction = (2.0, -1.0)
    velocity = (1.0, -1.0)
    effective_step = 1.0


class BDF2(Integrator):
    """Second-order backward differentiation, L-stable, far less numerical damping at the same cost.

    From x_{n+1} = 4/3 x_n - 1/3 x_{n-1} + 2/3 h v_{n+1}, the same for v, and v eliminated.
    """

    prediction = (8 / 3, -22 / 9, 8 / 9, -1 / 9)
    velocity = (1.5, -2.0, 0.5)
    effective_step = 2 / 3
