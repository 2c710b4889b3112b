"""Implicit steps with a potential that is frozen within a solve and renewed between solves.

What a contact touches changes while a step is solved. Asked anew in every Newton iteration it chatters; so it
is frozen while Newton's method runs, and renewed in a few outer passes.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toile.limits import Count
from toile.physics.cloth import Cloth
from toile.physics.implicit.integrators import Formula, Integrator
from toile.physics.implicit.linear_solvers.pattern import BlockPattern
from toile.physics.implicit.newton import NewtonSettings, StepSolution, minimise_incremental_potential
from toile.physics.implicit.potential import StepPotential
from toile.physics.implicit.simulator import ImplicitSimulator
from toile.physics.implicit.terms import SceneTerms
from toile.physics.material import Material
from toile.physics.simulator import StepResult, StepStatus
from toile.physics.state import State
from toile.physics.step_terms import StepContext, StepTerm

Array = NDArray[np.float64]


class RenewedPotential(StepPotential):
    """A potential of one step that is renewed where the last solve has led."""

    @abstractmethod
    def renew(self, x: Array) -> None:
        """Renew what is frozen, at positions x (N, 3) [m]."""

    def reachable(self, x: Array) -> Array:
        """What can be reached on the way from the step's begin to x (N, 3) [m]; x if nothing is between."""
        return x

    @abstractmethod
    def forces(self, x: Tensor, positions: Tensor) -> Tensor:
        """Force (N, 3) [N] at fixed x_{n+1}, differentiable by x_n and the potential's own numbers.

        Args:
            x: x_{n+1} (N, 3) [m], without gradients.
            positions: x_n (N, 3) [m].
        """


class PotentialSum(StepPotential):
    """Several potentials at once."""

    def __init__(self, parts: Sequence[StepPotential]) -> None:
        self.parts = tuple(parts)

    def total(self, x: Array, free: Array) -> float:
        """See StepPotential."""
        return sum(part.total(x, free) for part in self.parts)

    def gradient(self, x: Array) -> Array:
        """See StepPotential."""
        return sum((part.gradient(x) for part in self.parts), start=np.zeros_like(x))

    def add_hessian(self, blocks: Array, pattern: BlockPattern, x: Array, *, convex: bool) -> None:
        """See StepPotential."""
        for part in self.parts:
            part.add_hessian(blocks, pattern, x, convex=convex)


class RenewedSum(PotentialSum, RenewedPotential):
    """Several renewed potentials at once."""

    def __init__(self, parts: Sequence[RenewedPotential]) -> None:
        super().__init__(parts)
        self._renewed = tuple(parts)

    def renew(self, x: Array) -> None:
        """See RenewedPotential."""
        for part in self._renewed:
            part.renew(x)

    def reachable(self, x: Array) -> Array:
        """See RenewedPotential."""
        for part in self._renewed:
            x = part.reachable(x)
        return x

    def forces(self, x: Tensor, positions: Tensor) -> Tensor:
        """See RenewedPotential."""
        return torch.stack([part.forces(x, positions) for part in self._renewed]).sum(0)


class RenewingSimulator(ImplicitSimulator):
    """ImplicitSimulator whose steps are solved in several passes, with potentials renewed in between.

    Derivatives are those of the last pass: what is frozen in it does not change.

    Args:
        cloth: see ImplicitSimulator.
        time_step: h [s].
        integrator: see integrators.
        newton: of the last pass.
        passes: solves per step; as many again where the last one does not converge.
        loosely: tolerance of the passes before the last as a multiple of the last one's.
        terms: see ImplicitSimulator.
    """

    def __init__(
        self,
        cloth: Cloth,
        time_step: float | Tensor,
        integrator: Integrator,
        newton: NewtonSettings,
        passes: Count,
        loosely: float = 1.0,
        terms: Sequence[StepTerm] = (),
    ) -> None:
        super().__init__(cloth, time_step, integrator, newton, terms)
        self.passes = passes
        self._loose = replace(newton, tolerance=loosely * newton.tolerance)
        self._potentials: Sequence[RenewedPotential] = ()

    def step_with(
        self,
        potentials: Sequence[RenewedPotential],
        state: State,
        material: Material,
        forces: Tensor,
        boundary: Tensor,
        guess: Tensor | None = None,
        *,
        linearize: bool = False,
    ) -> StepResult:
        """One step with potentials of its own, one per scene; the other arguments as in Simulator.step."""
        self._potentials = potentials
        try:
            return self.step(state, material, forces, boundary, guess, linearize=linearize)
        finally:
            self._potentials = ()

    def _scenes(self, contexts: Sequence[StepContext], n: int) -> list[SceneTerms]:
        scenes = super()._scenes(contexts, n)
        if not self._potentials:
            return scenes
        return [
            replace(scene, vertices=own if scene.vertices is None else PotentialSum((scene.vertices, own)))
            for scene, own in zip(scenes, self._potentials, strict=True)
        ]

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
    ) -> list[StepSolution]:
        if not self._potentials:
            return super()._solve(
                starts, prediction, boundary, forces, stiffness, inertia, terms, linearize=linearize
            )
        solutions = []
        arguments = zip(starts, prediction, boundary, forces, stiffness, strict=True)
        for scene, term, own in zip(arguments, terms, self._potentials, strict=True):
            guesses, x_hat, ends, force, coefficients = scene
            term.prepare(self.assembly)
            guesses = np.array(guesses)
            guesses[:, self.assembly.pinned] = ends
            guesses = np.stack([own.reachable(guess) for guess in guesses])
            found: StepSolution | None = None
            iterations = 0
            for number in range(2 * self.passes):
                last = number >= self.passes - 1
                if found is not None:
                    own.renew(found.positions)
                found = minimise_incremental_potential(
                    self.assembly,
                    self.solver,
                    guesses if found is None else found.positions[None],
                    x_hat,
                    ends,
                    force,
                    coefficients,
                    inertia,
                    self.force_scale,
                    self.newton if last else self._loose,
                    linearize=linearize and last,
                    extra=term.vertices,
                    factor=None if found is None else found.factor,
                    keep_factor=True,
                )
                iterations += found.iterations
                if found.status is not StepStatus.NOT_FINITE:
                    reached = own.reachable(found.positions)
                    if reached is not found.positions:
                        found = replace(found, positions=reached, status=StepStatus.LINE_SEARCH_FAILED)
                # Where the last pass got stuck, others with renewed potentials may not.
                if last and found.status is StepStatus.CONVERGED:
                    break
            assert found is not None
            solutions.append(replace(found, iterations=iterations, factor=None))
        return solutions

    def _with_hidden_gradients(
        self,
        forces: Tensor,
        state: State,
        contexts: list[StepContext],
        formula: Formula,
        prediction: Tensor,
        positions: Tensor,
    ) -> Tensor:
        forces = super()._with_hidden_gradients(forces, state, contexts, formula, prediction, positions)
        if not (torch.is_grad_enabled() and self._potentials):
            return forces
        own = torch.stack(
            [
                potential.forces(x, start)
                for potential, x, start in zip(self._potentials, positions, state.positions, strict=True)
            ]
        )
        return forces + (own - own.detach())
