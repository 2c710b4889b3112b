"""The implicit simulator behind the common interface, differentiable by the implicit function theorem."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toile.physics.cloth import Cloth
from toile.physics.implicit.integrators import Integrator
from toile.physics.implicit.newton import (
    NewtonSettings,
    StepSolution,
    minimise_incremental_potential,
)
from toile.physics.implicit.terms import SceneTerms
from toile.physics.linearizable import LinearizableSimulator, extrapolations
from toile.physics.material import Material
from toile.physics.state import State
from toile.physics.step_terms import StepTerm

Array = NDArray[np.float64]


class ImplicitSimulator(LinearizableSimulator):
    """Backward Euler or BDF2 with a converged Newton solve in every step.

    Newton's method starts from the guess or an extrapolation of the past, whichever is lower.

    Args:
        cloth: elements, rest shape, masses and pinned vertices.
        time_step: h [s]; see LinearizableSimulator.
        integrator: see integrators.
        newton: see NewtonSettings.
        terms: what acts within the step besides, see StepTerm.
    """

    def __init__(
        self,
        cloth: Cloth,
        time_step: float | Tensor,
        integrator: Integrator,
        newton: NewtonSettings,
        terms: Sequence[StepTerm] = (),
    ) -> None:
        super().__init__(cloth, time_step, integrator, terms)
        self.newton = newton

    def _starts(
        self, state: State, material: Material, forces: Tensor, boundary: Tensor, guess: Tensor | None
    ) -> Tensor:
        """Candidate starts of Newton's method, (B, G, N, 3), detached: extrapolated past and warm start."""
        candidates = extrapolations(state.positions.detach(), state.past.detach())
        if guess is not None:
            candidates.append(guess.detach())
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
            solutions.append(
                minimise_incremental_potential(
                    self.assembly,
                    self.solver,
                    *scene,
                    inertia,
                    self.force_scale,
                    self.newton,
                    linearize=linearize,
                    extra=term.vertices,
                )
            )
        return solutions
