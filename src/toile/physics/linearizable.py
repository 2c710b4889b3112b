"""Simulators of implicit steps, whose derivatives Gauss-Newton and autograd can have at will."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from toile.physics.cloth import Cloth
from toile.physics.implicit.assembly import Assembly
from toile.physics.implicit.integrators import Formula, Integrator
from toile.physics.implicit.linear_solvers.base import LinearSolver
from toile.physics.implicit.linear_solvers.choice import chosen_solver
from toile.physics.implicit.newton import StepSolution, linearise
from toile.physics.implicit.terms import SceneTerms, TermMemory, depends_on_gradients, term_forces
from toile.physics.material import Material
from toile.physics.simulator import Simulator, StepResult
from toile.physics.state import State
from toile.physics.step_terms import StepContext, StepTerm

STANDARD_GRAVITY = 9.81

Array = NDArray[np.float64]


class LinearizableSimulator(Simulator):
    """A simulator of implicit steps: each minimises an incremental potential, exactly or nearly.

    Differentiable by the implicit function theorem at the positions that the step has found: one Hessian and
    one factorisation per scene, made with ``linearize=True`` or in the backward pass. How the minimum is
    found is left to the subclasses. Runs on the CPU in float64.

    Args:
        cloth: elements, rest shape, masses and pinned vertices; the masses may require gradients.
        time_step: h [s]; a tensor () that requires gradients gets them.
        integrator: gives prediction and effective step of every step.
        terms: what acts within the step besides, see StepTerm; gradients reach the numbers inside.

    Attributes:
        assembly: internal energy of the cloth.
        solver: for its Hessians.
        force_scale: weight of an interior vertex [N], which tolerances are fractions of.
    """

    def __init__(
        self,
        cloth: Cloth,
        time_step: float | Tensor,
        integrator: Integrator,
        terms: Sequence[StepTerm] = (),
    ) -> None:
        self.time_step = float(time_step.detach()) if isinstance(time_step, Tensor) else time_step
        if self.time_step <= 0:
            raise ValueError(f"time_step: expected a positive number of seconds, got {time_step}")
        self.cloth = cloth
        self.terms = tuple(terms)
        self._exact_step = time_step
        self.integrator = integrator
        self.n_past = integrator.history - 1
        self.assembly = Assembly.of(cloth)
        self.solver: LinearSolver = chosen_solver(
            self.assembly.pattern, self.assembly.pinned, grid=cloth.grid is not None
        )
        self._masses: Array = cloth.masses.detach().numpy()
        self.force_scale = float(self._masses.max()) * STANDARD_GRAVITY

    @abstractmethod
    def _starts(
        self, state: State, material: Material, forces: Tensor, boundary: Tensor, guess: Tensor | None
    ) -> Tensor:
        """Candidate starts of the minimisation, (B, G, N, 3) [m], detached."""

    @abstractmethod
    def _solve(
        self,
        starts: Array,
        prediction: Array,
        boundary: Array,
        forces: Array,
        stiffness: Array,
        inertia: Array,
        terms: Sequence[SceneTerms],
        *,
        linearize: bool,
    ) -> Sequence[StepSolution]:
        """The steps of a batch; arguments as in minimise_incremental_potential, with an axis B in front.

        Step terms come per scene; ``SceneTerms.prepare`` goes before whatever the assembly is asked.
        """

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
        """See Simulator.step.

        Raises:
            ValueError: an argument is of wrong shape or type.
        """
        self._check(state, material, forces, boundary, guess)
        formula = self.integrator.formula(state.steps)
        history = torch.cat((state.positions[:, None], state.past), dim=1)
        weights = torch.tensor(formula.prediction, dtype=history.dtype)
        prediction = (weights[None, :, None, None] * history[:, : self.integrator.history]).sum(1)
        stiffness = self.cloth.energies.coefficients(material.values)
        starts = self._starts(state, material, forces, boundary, guess)
        contexts = self._contexts(state, material, boundary)
        scenes = self._scenes(contexts, len(forces))
        inertia = self._inertia(formula)
        solutions = self._solve(
            starts.numpy(),
            prediction.detach().numpy(),
            boundary.detach().numpy(),
            forces.detach().numpy(),
            stiffness.detach().numpy(),
            inertia,
            scenes,
            linearize=linearize,
        )
        if linearize and contexts:
            solutions = [
                _with_memory(solution, self.terms, now)
                for solution, now in zip(solutions, contexts, strict=True)
            ]
        found = torch.from_numpy(np.stack([s.positions for s in solutions]))
        positions = self._with_gradients(
            state,
            inertia,
            solutions,
            scenes,
            found,
            prediction,
            stiffness,
            lambda x: self._with_hidden_gradients(forces, state, contexts, formula, prediction, x),
            boundary,
        )
        new_history = torch.cat((positions[:, None], history), dim=1)[:, : self.n_past + 1]
        d = torch.tensor(formula.velocity, dtype=history.dtype)
        velocities = (d[None, :, None, None] * new_history[:, : len(d)]).sum(1) / self._exact_step
        return StepResult(
            state=replace(
                state,
                positions=positions,
                velocities=velocities,
                past=new_history[:, 1:],
                steps=state.steps + 1,
            ),
            status=tuple(s.status for s in solutions),
            iterations=tuple(s.iterations for s in solutions),
            residual=tuple(s.residual for s in solutions),
            linearization=tuple(s.linearization for s in solutions),
        )

    def _with_gradients(
        self,
        state: State,
        inertia: Array,
        solutions: Sequence[StepSolution],
        scenes: list[SceneTerms],
        found: Tensor,
        prediction: Tensor,
        stiffness: Tensor,
        forces: Callable[[Tensor], Tensor],
        boundary: Tensor,
    ) -> Tensor:
        """The positions that the step has found (B, N, 3) [m], with the derivative of the minimum.

        The forces are those at given positions (B, N, 3), see ``_with_hidden_gradients``.
        """
        return implicit_positions(
            self, inertia, solutions, scenes, found, prediction, stiffness, forces(found), boundary
        )

    @property
    def inertia(self) -> NDArray[np.float64]:
        """Masses / (β h)² of a regular step, (N,) [kg/s²]."""
        return self._inertia(self.integrator.regular)

    def _inertia(self, formula: Formula) -> NDArray[np.float64]:
        return self._masses / (formula.effective_step * self.time_step) ** 2

    def _contexts(self, state: State, material: Material, boundary: Tensor) -> list[StepContext]:
        """What the step terms may know, one per scene; none without terms."""
        if not self.terms:
            return []
        return [
            StepContext(
                cloth=self.cloth,
                material=material.scene(b),
                positions=state.positions[b],
                velocities=state.velocities[b],
                time=float(state.began[b]) + (state.steps + 1) * self.time_step,
                time_step=self._exact_step,
                boundary=boundary[b],
            )
            for b in range(len(boundary))
        ]

    def _scenes(self, contexts: Sequence[StepContext], n: int) -> list[SceneTerms]:
        """What acts within the step in each of n scenes."""
        return [SceneTerms.of(self.terms, now) for now in contexts] or [SceneTerms()] * n

    def _with_hidden_gradients(
        self,
        forces: Tensor,
        state: State,
        contexts: list[StepContext],
        formula: Formula,
        prediction: Tensor,
        positions: Tensor,
    ) -> Tensor:
        """The forces, of the same value, with the gradients of whatever else pulls at the cloth.

        Terms, masses and time step change the out-of-balance force as an external force would; the adjoint
        of the step passes on what it knows of forces.
        """
        if not torch.is_grad_enabled():
            return forces
        if any(depends_on_gradients(self.terms, now) for now in contexts):
            of_terms = torch.stack(
                [term_forces(self.terms, now, x) for now, x in zip(contexts, positions, strict=True)]
            )
            forces = forces + (of_terms - of_terms.detach())
        inertia = self.cloth.masses / (formula.effective_step * self._exact_step) ** 2
        if inertia.requires_grad:
            forces = forces - (inertia - inertia.detach())[:, None] * (positions - prediction.detach())
        return forces

    def _check(
        self, state: State, material: Material, forces: Tensor, boundary: Tensor, guess: Tensor | None
    ) -> None:
        batch, n = state.positions.shape[0], self.cloth.n_vertices
        expected = {
            "positions": (state.positions, (batch, n, 3)),
            "velocities": (state.velocities, (batch, n, 3)),
            "past": (state.past, (batch, self.n_past, n, 3)),
            "material": (material.values, (batch, len(self.cloth.energies.parameters))),
            "forces": (forces, (batch, n, 3)),
            "boundary": (boundary, (batch, len(self.cloth.pinned), 3)),
        }
        if guess is not None:
            expected["guess"] = (guess, (batch, n, 3))
        for name, (tensor, shape) in expected.items():
            if tuple(tensor.shape) != shape or tensor.dtype != torch.float64 or tensor.device.type != "cpu":
                raise ValueError(
                    f"{name}: expected float64 of shape {shape} on the CPU, "
                    f"got {tensor.dtype} of shape {tuple(tensor.shape)} on {tensor.device}"
                )


def implicit_positions(
    simulator: LinearizableSimulator,
    inertia: Array,
    solutions: Sequence[StepSolution],
    scenes: list[SceneTerms],
    found: Tensor,
    prediction: Tensor,
    stiffness: Tensor,
    forces: Tensor,
    boundary: Tensor,
) -> Tensor:
    """Minima (B, N, 3) [m] of a step, differentiable by the implicit function theorem.

    Args:
        simulator: whose minima.
        inertia: masses / (β h)², (N,) [kg/s²].
        solutions: of every scene.
        scenes: what else acts in them, as it was at the minima.
        found: the minima, without gradients.
        prediction: x̂ (B, N, 3) [m].
        stiffness: (B, C) coefficients of the energies.
        forces: f (B, N, 3) [N].
        boundary: positions of the pinned vertices (B, n_pinned, 3) [m].
    """
    positions: Tensor = _ImplicitStep.apply(
        simulator, inertia, solutions, scenes, found, prediction, stiffness, forces, boundary
    )
    return positions


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


def _with_memory(solution: StepSolution, terms: Sequence[StepTerm], now: StepContext) -> StepSolution:
    if solution.linearization is None:
        return solution
    memory = TermMemory(terms, now, torch.from_numpy(solution.positions))
    return replace(solution, linearization=replace(solution.linearization, memory=memory))


class _ImplicitStep(torch.autograd.Function):
    """x(x̂, k, f, boundary positions) = argmin Φ, with the adjoint H λ = ∂J/∂x of the optimality condition."""

    @staticmethod
    def forward(
        ctx: Any,
        simulator: LinearizableSimulator,
        inertia: NDArray[np.float64],
        solutions: Sequence[StepSolution],
        scenes: list[SceneTerms],
        positions: Tensor,
        prediction: Tensor,
        stiffness: Tensor,
        forces: Tensor,
        boundary: Tensor,
    ) -> Tensor:
        ctx.simulator, ctx.inertia, ctx.solutions, ctx.scenes = simulator, inertia, solutions, scenes
        ctx.stiffness = stiffness.detach()
        return positions.clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Any, ...]:
        simulator: LinearizableSimulator = ctx.simulator
        assembly = simulator.assembly
        (gradient,) = gradients
        to_prediction, to_stiffness, to_forces, to_boundary = [], [], [], []
        for b, (solution, scene) in enumerate(zip(ctx.solutions, ctx.scenes, strict=True)):
            k = ctx.stiffness[b].numpy()
            linear = solution.linearization
            if linear is None:
                scene.prepare(assembly)
                unit = assembly.gradients(solution.positions)
                linear = linearise(
                    assembly, simulator.solver, solution.positions, unit, k, ctx.inertia, scene.vertices
                )
            g = gradient[b].numpy()
            adjoint = linear.factor.solve(g)
            to_forces.append(adjoint)
            to_prediction.append(linear.inertia[:, None] * adjoint)
            to_stiffness.append(-(linear.unit_gradients * adjoint).sum((1, 2)))
            to_boundary.append(g[assembly.pinned] - (linear.coupling @ adjoint.reshape(-1)).reshape(-1, 3))
        stacked = [
            torch.from_numpy(np.stack(a)) for a in (to_prediction, to_stiffness, to_forces, to_boundary)
        ]
        return (None, None, None, None, None, *stacked)
