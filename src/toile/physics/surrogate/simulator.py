"""The surrogate behind the common interface: SI in and out, network units inside."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toile.errors import InputError
from toile.limits import Count, CountOrZero
from toile.physics.cloth import GRID_PARAMETERS, Cloth, cell_shares
from toile.physics.implicit.integrators import Integrator
from toile.physics.implicit.newton import Linearization, StepSolution, linearise
from toile.physics.implicit.terms import SceneTerms
from toile.physics.linearizable import LinearizableSimulator, extrapolations
from toile.physics.material import Material
from toile.physics.simulator import StepStatus
from toile.physics.state import State
from toile.physics.step_terms import StepTerm
from toile.physics.surrogate.problem import StepProblem
from toile.physics.surrogate.weights import load_weights
from toile.physics.units import NetworkUnits

_SMALLEST_GRID = 4

Array = NDArray[np.float64]


class SurrogateSimulator(LinearizableSimulator):
    """The implicit step of the same integrator, solved by the network instead of Newton's method.

    One batch is one call of the network; a guess is ignored. Gradients are those of the implicit function
    theorem at the network's solution: they are as exact as the solution is, and far cheaper than
    backpropagation through the network.

    Args:
        cloth: a grid at least 4×4, at rest flat with right angles, uniform areal density.
        time_step: h [s].
        integrator: see integrators.
        passes: passes of the network per step; 0 leaves the line relaxation alone.
        sweeps: relaxations of the warp and weft lines after each pass.
        weights: file written by ``toile train``; those of the package if None.
        terms: must be empty: the network knows the plain step only.

    Raises:
        ValueError: the cloth is not one the network knows.
        InputError: the weights cannot be used, or there are step terms.
    """

    def __init__(
        self,
        cloth: Cloth,
        time_step: float | Tensor,
        integrator: Integrator,
        passes: Count,
        sweeps: CountOrZero = 2,
        weights: str | Path | None = None,
        terms: Sequence[StepTerm] = (),
    ) -> None:
        if terms:
            raise InputError(
                "the surrogate cannot take effects that act within a step",
                where="simulator=surrogate",
                expected="simulator=implicit or simulator=hybrid",
                got=", ".join(type(term).__name__ for term in terms),
            )
        super().__init__(cloth, time_step, integrator)
        if passes < 0:
            raise ValueError(f"passes: expected 0 or more, got {passes}")
        if sweeps < 1:
            raise ValueError(f"sweeps: expected at least 1, got {sweeps}")
        self.passes = passes
        self.sweeps = sweeps
        self.surrogate = load_weights(None if weights is None else Path(weights))
        self._grid = _checked_grid(cloth)
        height, width = self._grid
        self._length = float(cloth.rest_lengths.mean())
        masses = cloth.masses.detach()
        self._mass = float(masses.max())
        self._grid_masses = (masses / self._mass).reshape(height, width).float()
        rest = (cloth.rest_lengths / self._length).float()
        self._rest_i = rest[: (height - 1) * width].reshape(height - 1, width)
        self._rest_j = rest[(height - 1) * width :].reshape(height, width - 1)
        free = torch.ones(cloth.n_vertices)
        free[cloth.pinned] = 0.0
        self._free = free.reshape(height, width)

    def _starts(
        self, state: State, material: Material, forces: Tensor, boundary: Tensor, guess: Tensor | None
    ) -> Tensor:
        now = state.positions.detach()
        # Standing still is among the starts: then backward Euler never gains energy (see docs/surrogate.md).
        # No guess: the network stops where its passes end, and what a motion is must follow from its past and
        # its forces alone.
        return torch.stack((now, *extrapolations(now, state.past.detach())), 1)

    @torch.no_grad()
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
        units = NetworkUnits(self._mass, self._length, float(np.sqrt(self._mass / inertia.max())))
        # Coordinates stay small wherever the cloth is.
        origin = prediction.mean(1)[:, None]
        problem = self._problem(starts, prediction, boundary, forces, stiffness, inertia, units, origin)
        solved, residual = self.surrogate.solve(problem, self.passes, self.sweeps)
        positions = solved.numpy().reshape(prediction.shape) * self._length + origin
        positions[:, self.assembly.pinned] = boundary
        largest = residual.flatten(1).abs().amax(1).tolist()
        return [
            self._solution(x, k, float(r) * units.force, inertia, linearize=linearize)
            for x, k, r in zip(positions, stiffness, largest, strict=True)
        ]

    def _problem(
        self,
        starts: Array,
        prediction: Array,
        boundary: Array,
        forces: Array,
        stiffness: Array,
        inertia: Array,
        units: NetworkUnits,
        origin: Array,
    ) -> StepProblem:
        """The steps in network units."""
        batch = len(prediction)
        fall = prediction + forces / inertia[:, None]
        candidates = np.concatenate((starts, fall[:, None]), 1)
        candidates[:, :, self.assembly.pinned] = boundary[:, None]
        scale = np.array([units.stretching, units.energy, units.energy])

        def grid(points: Array) -> Tensor:
            return torch.from_numpy(points).reshape(*points.shape[:-2], *self._grid, 3)

        return StepProblem(
            prediction=grid((prediction - origin) / self._length),
            starts=grid((candidates - origin[:, None]) / self._length),
            forces=grid(forces / units.force).float(),
            stiffness=torch.from_numpy(stiffness / scale).float(),
            masses=self._grid_masses,
            free=self._free.expand(batch, -1, -1),
            rest_lengths_i=self._rest_i.expand(batch, -1, -1),
            rest_lengths_j=self._rest_j.expand(batch, -1, -1),
        )

    def _solution(
        self, positions: Array, stiffness: Array, residual: float, inertia: Array, *, linearize: bool
    ) -> StepSolution:
        if not (np.isfinite(positions).all() and np.isfinite(residual)):
            return StepSolution(positions, StepStatus.NOT_FINITE, 0, float("nan"), None)
        linearization: Linearization | None = None
        if linearize:
            unit_gradients = self.assembly.gradients(positions)
            linearization = linearise(
                self.assembly, self.solver, positions, unit_gradients, stiffness, inertia
            )
        return StepSolution(positions, StepStatus.CONVERGED, 0, residual, linearization)


def _checked_grid(cloth: Cloth) -> tuple[int, int]:
    names = cloth.energies.parameters.names
    if cloth.grid is None or names != GRID_PARAMETERS.names:
        raise ValueError(
            f"cloth: the surrogate expects a grid with {', '.join(GRID_PARAMETERS.names)}, got "
            f"{'a general mesh' if cloth.grid is None else 'a grid'} with {', '.join(names)}"
        )
    if min(cloth.grid) < _SMALLEST_GRID:
        raise ValueError(
            f"cloth: the surrogate expects a grid of at least {_SMALLEST_GRID}×{_SMALLEST_GRID}, "
            f"got {cloth.grid}"
        )
    if not bool(torch.allclose(cloth.energies.named("shearing").rest, torch.tensor(torch.pi / 2).double())):
        raise ValueError("cloth: the surrogate expects right angles between warp and weft at rest")
    masses = cloth.masses.detach()
    uniform = masses.max() * cell_shares(*cloth.grid).reshape(-1)
    if not bool(torch.allclose(masses, uniform, rtol=1e-3)):
        raise ValueError("cloth: the surrogate expects a uniform areal density")
    return cloth.grid
