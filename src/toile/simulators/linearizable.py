"""Simulators of implicit steps, whose derivatives Gauss-Newton and autograd can have at will."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from toile.cloth.cloth import Cloth
from toile.cloth.material import Material
from toile.cloth.state import State
from toile.simulators.base import Simulator, StepResult
from toile.simulators.implicit.assembly import Assembly
from toile.simulators.implicit.integrators import Formula, Integrator
from toile.simulators.implicit.newton import StepSolution, linearise

STANDARD_GRAVITY = 9.81

Array = NDArray[np.float64]


class LinearizableSimulator(Simulator):
    """A simulator of implicit steps: each minimises an incremental potential, exactly or nearly.

    Differentiable by the implicit function theorem at the positions that the step has found: one Hessian and
    one factorisation per scene, made with ``linearize=True`` or in the backward pass. How the minimum is
    found is left to the subclasses. Runs on the CPU in float64.

    Args:
        cloth: elements, rest shape, masses and held vertices.
        time_step: h [s].
        integrator: gives prediction and effective step of every step.

    Attributes:
        assembly: internal energy of the cloth; fixes the order of the unknowns in a linearization.
        force_scale: weight of an interior vertex [N], which tolerances are fractions of.
    """

    def __init__(self, cloth: Cloth, time_step: float, integrator: Integrator) -> None:
        if time_step <= 0:
            raise ValueError(f"time_step: expected a positive number of seconds, got {time_step}")
        self.cloth = cloth
        self.time_step = time_step
        self.integrator = integrator
        self.n_past = integrator.history - 1
        self.assembly = Assembly(
            cloth.stencils, cloth.rest_lengths.numpy(), cloth.rest_corner_angles.numpy(), cloth.held.numpy()
        )
        self.force_scale = float(cloth.masses.max()) * STANDARD_GRAVITY

    @abstractmethod
    def _starts(
        self, state: State, material: Material, forces: Tensor, anchors: Tensor, guess: Tensor | None
    ) -> Tensor:
        """Candidate starts of the minimisation, (B, G, N, 3) [m], detached."""

    @abstractmethod
    def _solve(
        self,
        starts: Array,
        prediction: Array,
        anchors: Array,
        forces: Array,
        stiffness: Array,
        inertia: Array,
        *,
        linearize: bool,
    ) -> list[StepSolution]:
        """The steps of a batch; arguments as in minimise_incremental_potential, with an axis B in front."""

    def step(
        self,
        state: State,
        material: Material,
        forces: Tensor,
        anchors: Tensor,
        guess: Tensor | None = None,
        *,
        linearize: bool = False,
    ) -> StepResult:
        """See Simulator.step.

        Raises:
            ValueError: an argument is of wrong shape or type.
        """
        self._check(state, material, forces, anchors, guess)
        formula = self.integrator.formula(state.steps)
        history = torch.cat((state.positions[:, None], state.past), dim=1)
        weights = torch.tensor(formula.prediction, dtype=history.dtype)
        prediction = (weights[None, :, None, None] * history[:, : self.integrator.history]).sum(1)
        stiffness = torch.stack((material.stretching, material.shearing, material.bending), -1)
        starts = self._starts(state, material, forces, anchors, guess)
        solutions: list[StepSolution] = []
        positions: Tensor = _ImplicitStep.apply(
            self, self._inertia(formula), solutions, linearize, starts, prediction, stiffness, forces, anchors
        )
        new_history = torch.cat((positions[:, None], history), dim=1)[:, : self.n_past + 1]
        d = torch.tensor(formula.velocity, dtype=history.dtype)
        velocities = (d[None, :, None, None] * new_history[:, : len(d)]).sum(1) / self.time_step
        return StepResult(
            state=State(positions, velocities, new_history[:, 1:], state.steps + 1),
            status=tuple(s.status for s in solutions),
            iterations=tuple(s.iterations for s in solutions),
            residual=tuple(s.residual for s in solutions),
            linearization=tuple(s.linearization for s in solutions),
        )

    @property
    def inertia(self) -> NDArray[np.float64]:
        """Masses / (β h)² of a regular step, (N,) [kg/s²]."""
        return self._inertia(self.integrator.regular)

    def _inertia(self, formula: Formula) -> NDArray[np.float64]:
        return self.cloth.masses.numpy() / (formula.effective_step * self.time_step) ** 2

    def _check(
        self, state: State, material: Material, forces: Tensor, anchors: Tensor, guess: Tensor | None
    ) -> None:
        batch, n = state.positions.shape[0], self.cloth.n_vertices
        expected = {
            "positions": (state.positions, (batch, n, 3)),
            "velocities": (state.velocities, (batch, n, 3)),
            "past": (state.past, (batch, self.n_past, n, 3)),
            "stretching stiffness": (material.stretching, (batch,)),
            "shearing stiffness": (material.shearing, (batch,)),
            "bending stiffness": (material.bending, (batch,)),
            "forces": (forces, (batch, n, 3)),
            "anchors": (anchors, (batch, len(self.cloth.held), 3)),
        }
        if guess is not None:
            expected["guess"] = (guess, (batch, n, 3))
        for name, (tensor, shape) in expected.items():
            if tuple(tensor.shape) != shape or tensor.dtype != torch.float64 or tensor.device.type != "cpu":
                raise ValueError(
                    f"{name}: expected float64 of shape {shape} on the CPU, "
                    f"got {tensor.dtype} of shape {tuple(tensor.shape)} on {tensor.device}"
                )


def extrapolations(now: Tensor, past: Tensor) -> list[Tensor]:
    """Linear and, if the past is long enough, quadratic continuation of a motion.

    Args:
        now: x_n (B, ...).
        past: x_{n-1}, x_{n-2}, ... (B, K, ...), K ≥ 1.

    Returns:
        One or two tensors like ``now``.
    """
    found = [2 * now - past[:, 0]]
    if past.shape[1] > 1:
        found.append(3 * now - 3 * past[:, 0] + past[:, 1])
    return found


class _ImplicitStep(torch.autograd.Function):
    """x(x̂, k, f, anchors) = argmin Φ, with the adjoint H λ = ∂J/∂x of the optimality condition."""

    @staticmethod
    def forward(
        ctx: Any,
        simulator: LinearizableSimulator,
        inertia: NDArray[np.float64],
        solutions: list[StepSolution],
        linearize: bool,
        starts: Tensor,
        prediction: Tensor,
        stiffness: Tensor,
        forces: Tensor,
        anchors: Tensor,
    ) -> Tensor:
        solutions += simulator._solve(
            starts.numpy(),
            prediction.detach().numpy(),
            anchors.detach().numpy(),
            forces.detach().numpy(),
            stiffness.detach().numpy(),
            inertia,
            linearize=linearize,
        )
        ctx.simulator, ctx.inertia, ctx.solutions = simulator, inertia, list(solutions)
        ctx.stiffness = stiffness.detach()
        return torch.from_numpy(np.stack([s.positions for s in solutions]))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Any, ...]:
        simulator: LinearizableSimulator = ctx.simulator
        assembly = simulator.assembly
        (gradient,) = gradients
        to_prediction, to_stiffness, to_forces, to_anchors = [], [], [], []
        for b, solution in enumerate(ctx.solutions):
            k = ctx.stiffness[b].numpy()
            linear = solution.linearization
            if linear is None:
                unit = assembly.gradients(solution.positions)
                linear = linearise(assembly, solution.positions, unit, k, ctx.inertia)
            g = gradient[b].numpy()
            adjoint = assembly.from_band(linear.factor.solve(assembly.to_band(g * assembly.free)))
            to_forces.append(adjoint)
            to_prediction.append(linear.inertia[:, None] * adjoint)
            to_stiffness.append(-(linear.unit_gradients * adjoint).sum((1, 2)))
            to_anchors.append(g[assembly.held] - (linear.coupling @ adjoint.reshape(-1)).reshape(-1, 3))
        stacked = [
            torch.from_numpy(np.stack(a)) for a in (to_prediction, to_stiffness, to_forces, to_anchors)
        ]
        return (None, None, None, None, None, *stacked)
