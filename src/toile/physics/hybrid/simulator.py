"""A quick predictor, polished by a few Newton corrections with the exact Hessian."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toile.limits import CountOrZero, Positive
from toile.physics.cloth import Cloth
from toile.physics.implicit.integrators import Integrator
from toile.physics.implicit.newton import NewtonSettings, StepSolution, minimise_incremental_potential
from toile.physics.implicit.terms import SceneTerms
from toile.physics.linearizable import LinearizableSimulator, extrapolations
from toile.physics.material import Material
from toile.physics.simulator import Simulator, StepStatus
from toile.physics.state import State
from toile.physics.step_terms import StepTerm

Array = NDArray[np.float64]


class HybridSimulator(LinearizableSimulator):
    """Implicit steps with a bounded number of Hessians: predicted, then corrected.

    Newton's method starts from the predictor's positions or the extrapolated past, whichever has the lowest
    potential (a guess is ignored), and stops after ``corrections`` Hessians or at the tolerance. Both are a
    success; the out-of-balance force that is left is the step's ``residual``.

    Args:
        cloth: elements, rest shape, masses and pinned vertices.
        time_step: h [s].
        integrator: see integrators.
        predictor: builds the predictor from (cloth, time step), with as long a past as the integrator's. No
            derivatives are taken through it. None starts from the extrapolated past alone.
        corrections: Newton corrections at most, each with a new Hessian; 0 takes the prediction as it is.
        tolerance: out-of-balance force that needs no (further) correction, as a fraction of the weight of an
            interior vertex.
        max_halvings: see NewtonSettings.
        largest_residual: out-of-balance force above which a step has failed, as a fraction of the weight of
            an interior vertex; None for no limit.
        fresh_linearization: linearise at the corrected positions, for one more Hessian and factorisation a
            step. Otherwise the factor of the last correction serves, at no cost, but it is that of the
            positions where the correction began, and such errors add up over the steps: on a swinging cloth
            and 24 steps, starts a hundred times closer than extrapolation leave the tangents 2 % off, the
            gradients of the stiffnesses 5 % and more; fresh ones are as good as the positions (1e-5).
        terms: what acts within the step besides, see StepTerm. The predictor knows nothing of them.
    """

    def __init__(
        self,
        cloth: Cloth,
        time_step: float | Tensor,
        integrator: Integrator,
        predictor: Callable[[Cloth, float], Simulator] | None,
        corrections: CountOrZero = 2,
        tolerance: Positive = 1e-4,
        max_halvings: CountOrZero = 12,
        largest_residual: Positive | None = None,
        fresh_linearization: bool = True,
        terms: Sequence[StepTerm] = (),
    ) -> None:
        if corrections < 0:
            raise ValueError(f"corrections: expected 0 or more, got {corrections}")
        if largest_residual is not None and not largest_residual > 0:
            raise ValueError(f"largest_residual: expected a positive number or None, got {largest_residual}")
        super().__init__(cloth, time_step, integrator, terms)
        self.newton = NewtonSettings(tolerance, corrections, max_halvings)
        plain = replace(cloth, masses=cloth.masses.detach())
        self.predictor = None if predictor is None else predictor(plain, self.time_step)
        if self.predictor is not None and self.predictor.n_past != self.n_past:
            raise ValueError(
                f"predictor: expected one that keeps {self.n_past} past positions as the integrator does, "
                f"got {self.predictor.n_past}"
            )
        self.largest_residual = largest_residual
        self.fresh_linearization = fresh_linearization

    @torch.no_grad()
    def _starts(
        self, state: State, material: Material, forces: Tensor, boundary: Tensor, guess: Tensor | None
    ) -> Tensor:
        candidates = extrapolations(state.positions, state.past)
        if self.predictor is not None:
            # Instead of the quadratic continuation.
            candidates[1:] = [self.predictor.step(state, material, forces, boundary).state.positions]
        # No guess: where the corrections run out, the result depends on the start, and what a motion is must
        # follow from its past and its forces alone.
        return torch.stack(candidates, 1)

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
        solutions = []
        arguments = zip(starts, prediction, boundary, forces, stiffness, strict=True)
        for scene, term in zip(arguments, terms, strict=True):
            term.prepare(self.assembly)
            solution = minimise_incremental_potential(
                self.assembly,
                self.solver,
                *scene,
                inertia,
                self.force_scale,
                self.newton,
                linearize=linearize,
                fresh_linearization=self.fresh_linearization,
                extra=term.vertices,
            )
            if solution.status is StepStatus.MAX_ITERATIONS and not self._too_far(solution.residual):
                solution = replace(solution, status=StepStatus.CONVERGED)
            solutions.append(solution)
        return solutions

    def _too_far(self, residual: float) -> bool:
        return self.largest_residual is not None and residual > self.largest_residual * self.force_scale
