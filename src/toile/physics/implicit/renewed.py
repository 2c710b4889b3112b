"""Implicit steps with a potential that is frozen within a solve and renewed between solves.

What a contact touches changes while a step is solved. Asked anew in every Newton iteration it chatters; so it
is frozen while Newton's method runs, and renewed in a few outer passes.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toile.limits import Count
from toile.physics.cloth import Cloth
from toile.physics.implicit.integrators import Integrator
from toile.physics.implicit.linear_solvers.pattern import BlockPattern
from toile.physics.implicit.newton import NewtonSettings, StepSolution, minimise_incremental_potential
from toile.physics.implicit.potential import StepPotential
from toile.physics.implicit.simulator import ImplicitSimulator
from toile.physics.implicit.terms import SceneTerms
from toile.physics.linearizable import implicit_positions
from toile.physics.material import Material
from toile.physics.simulator import SimulationError, StepResult, StepStatus
from toile.physics.state import State
from toile.physics.step_terms import StepTerm

Array = NDArray[np.float64]


class RenewedPotential(StepPotential):
    """A potential of one step that is renewed where the last solve has led."""

    @abstractmethod
    def renew(self, x: Array) -> None:
        """Renew what is frozen, at positions x (N, 3) [m]."""

    def reachable(self, x: Array) -> Array:
        """What can be reached on the way from the step's begin to x (N, 3) [m]; x if nothing is between."""
        return x

    @property
    def differentiable(self) -> bool:
        """Whether its forces follow from numbers of its own that require gradients."""
        return False

    def frozen(self) -> RenewedPotential:
        """As it is now: what is renewed later is not renewed there."""
        return copy(self)

    @abstractmethod
    def forces(self, x: Tensor, positions: Tensor, renewed: Tensor) -> Tensor:
        """Force (N, 3) [N] at fixed x_{n+1}, differentiable by all that it follows from.

        Args:
            x: x_{n+1} (N, 3) [m], without gradients.
            positions: x_n (N, 3) [m].
            renewed: where it was renewed last, x_n before (N, 3) [m].
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

    @property
    def differentiable(self) -> bool:
        """See RenewedPotential."""
        return any(part.differentiable for part in self._renewed)

    def frozen(self) -> RenewedSum:
        """See RenewedPotential."""
        return RenewedSum([part.frozen() for part in self._renewed])

    def forces(self, x: Tensor, positions: Tensor, renewed: Tensor) -> Tensor:
        """See RenewedPotential."""
        return torch.stack([part.forces(x, positions, renewed) for part in self._renewed]).sum(0)


@dataclass(frozen=True)
class RenewedSolution(StepSolution):
    """A step in several passes.

    Attributes:
        passes: solution of each, and the potential as it was there; only where gradients may be asked for.
    """

    passes: tuple[tuple[StepSolution, RenewedPotential], ...] = ()


class RenewingSimulator(ImplicitSimulator):
    """ImplicitSimulator whose steps are solved in several passes, with potentials renewed in between.

    Derivatives are those of all passes one after the other: each is a minimum by the implicit function
    theorem, and what was renewed in between follows from the one before. A pass that did not converge is no
    minimum; what the next one knows of it counts as given. A step that did not converge has no derivative.

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
        if not self._potentials:
            return super()._solve(
                starts, prediction, boundary, forces, stiffness, inertia, terms, linearize=linearize
            )
        solutions = []
        arguments = zip(starts, prediction, boundary, forces, stiffness, strict=True)
        for scene, term, own in zip(arguments, terms, self._potentials, strict=True):
            guesses, x_hat, ends, force, coefficients = scene
            acting = _with(term, own)
            term.prepare(self.assembly)
            guesses = np.array(guesses)
            guesses[:, self.assembly.pinned] = ends
            guesses = np.stack([own.reachable(guess) for guess in guesses])
            found: StepSolution | None = None
            iterations = 0
            passes = []
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
                    extra=acting.vertices,
                    factor=None if found is None else found.factor,
                    keep_factor=True,
                )
                iterations += found.iterations
                if found.status is not StepStatus.NOT_FINITE:
                    reached = own.reachable(found.positions)
                    if reached is not found.positions:
                        found = replace(found, positions=reached, status=StepStatus.LINE_SEARCH_FAILED)
                if torch.is_grad_enabled():
                    passes.append((replace(found, factor=None), own.frozen()))
                # Where the last pass got stuck, others with renewed potentials may not.
                if last and found.status is StepStatus.CONVERGED:
                    break
            assert found is not None
            solutions.append(
                RenewedSolution(
                    found.positions,
                    found.status,
                    iterations,
                    found.residual,
                    found.linearization,
                    passes=tuple(passes),
                )
            )
        return solutions

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
        inputs = state.positions, prediction, stiffness, boundary, forces(found)
        asked = any(given.requires_grad for given in inputs)
        asked |= any(own.differentiable for own in self._potentials)
        if not (self._potentials and torch.is_grad_enabled() and asked):
            return super()._with_gradients(
                state, inertia, solutions, scenes, found, prediction, stiffness, forces, boundary
            )
        every = []
        for b, (solution, scene) in enumerate(zip(solutions, scenes, strict=True)):
            assert isinstance(solution, RenewedSolution)
            start = state.positions[b]
            renewed = reached = start
            for part, own in solution.passes:
                x = torch.from_numpy(part.positions)
                # One scene's forces depend on no other's positions.
                own_forces = own.forces(x, start, renewed)
                at = forces(torch.cat((found[:b], x[None], found[b + 1 :])))[b]
                reached = implicit_positions(
                    self,
                    inertia,
                    [part],
                    [_with(scene, own)],
                    x[None],
                    prediction[b][None],
                    stiffness[b][None],
                    (at + (own_forces - own_forces.detach()))[None],
                    boundary[b][None],
                )[0]
                renewed = reached if part.status is StepStatus.CONVERGED else x
            if solution.status is not StepStatus.CONVERGED and reached.requires_grad:
                reached.register_hook(_refused)
            every.append(reached)
        return torch.stack(every)


def _with(scene: SceneTerms, own: RenewedPotential) -> SceneTerms:
    """What acts within the step, and the potential of its own."""
    return replace(scene, vertices=own if scene.vertices is None else PotentialSum((scene.vertices, own)))


def _refused(gradient: Tensor) -> None:
    raise SimulationError("a step that did not converge is no minimum: it has no gradients")
