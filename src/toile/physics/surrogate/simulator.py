"""The surrogate behind the common interface: SI in and out, network units inside."""

from __future__ import annotations

from collections.abc import Callable, Sequence
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
from toile.physics.surrogate.gradients import ImplicitFunction, StepGradient, UnrolledStep
from toile.physics.surrogate.problem import StepProblem
from toile.physics.surrogate.weights import load_weights
from toile.physics.units import NetworkUnits

_SMALLEST_GRID = 4

Array = NDArray[np.float64]


class SurrogateSimulator(LinearizableSimulator):
    """The implicit step of the same integrator, solved by the network instead of Newton's method.

    One batch is one call of the network; a guess is ignored. Gradients are by default those of the implicit
    function theorem at the network's solution: they are as exact as the solution is, and cheaper than
    backpropagation through the network, which is the other choice. Linearisations are of the first kind.

    Args:
        cloth: a grid at least 4×4, at rest flat with right angles, uniform areal density.
        time_step: h [s].
        integrator: see integrators.
        passes: passes of the network per step; 0 leaves the line relaxation alone.
        sweeps: relaxations of the warp and weft lines after each pass.
        weights: file written by ``toile train``; those of the package if None.
        gradient: see gradients.
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
        gradient: StepGradient | None = None,
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
        self.gradient = gradient or ImplicitFunction()
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
        # Standing still is among the starts: then backward Euler never gains energy (see docs/surrogate.md).
        # No guess: the network stops where its passes end, and what a motion is must follow from its past and
        # its forces alone.
        return _candidates(state).detach()

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
    ) -> Sequence[StepSolution]:
        problem, origin = self._problem(
            torch.from_numpy(starts),
            torch.from_numpy(prediction),
            torch.from_numpy(boundary),
            torch.from_numpy(forces),
            torch.from_numpy(stiffness),
            inertia,
        )
        solved, residual = self.surrogate.solve(problem, self.passes, self.sweeps)
        positions = (solved.reshape(prediction.shape) * self._length + origin).numpy()
        positions[:, self.assembly.pinned] = boundary
        largest = (residual.flatten(1).abs().amax(1) * self._units(inertia).force).tolist()
        return [
            self._solution(x, k, r, inertia, linearize=linearize)
            for x, k, r in zip(positions, stiffness, largest, strict=True)
        ]

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
        """See LinearizableSimulator; the derivative is the one chosen."""

        def of_minimum() -> Tensor:
            return super(SurrogateSimulator, self)._with_gradients(
                state, inertia, solutions, scenes, found, prediction, stiffness, forces, boundary
            )

        def of_computation() -> Tensor:
            problem, origin = self._problem(
                _candidates(state), prediction, boundary, forces(found), stiffness, inertia
            )
            inside = ((found - origin) / self._length).reshape(problem.prediction.shape)
            asked = (problem.starts, problem.prediction, problem.forces, problem.stiffness)
            solved: Tensor = UnrolledStep.apply(
                self.surrogate, self.passes, self.sweeps, problem, inside, *asked
            )
            positions = solved.reshape(found.shape) * self._length + origin
            return positions.index_copy(1, self.cloth.pinned, boundary)

        return self.gradient.positions(of_minimum, of_computation)

    def _units(self, inertia: Array) -> NetworkUnits:
        return NetworkUnits(self._mass, self._length, float(np.sqrt(self._mass / inertia.max())))

    def _problem(
        self,
        starts: Tensor,
        prediction: Tensor,
        boundary: Tensor,
        forces: Tensor,
        stiffness: Tensor,
        inertia: Array,
    ) -> tuple[StepProblem, Tensor]:
        """The steps in network units, and their origins (B, 1, 3) [m].

        Coordinates stay small wherever the cloth is; as moving the world moves the answer, an origin is a
        constant.
        """
        units = self._units(inertia)
        origin = prediction.detach().mean(1, keepdim=True)
        fall = prediction + forces / torch.from_numpy(inertia)[:, None]
        candidates = torch.cat((starts, fall[:, None]), 1)
        pinned = boundary[:, None].expand(-1, candidates.shape[1], -1, -1)
        candidates = candidates.index_copy(2, self.cloth.pinned, pinned)
        scale = torch.tensor([units.stretching, units.energy, units.energy], dtype=stiffness.dtype)

        def grid(points: Tensor) -> Tensor:
            return points.reshape(*points.shape[:-2], *self._grid, 3)

        batch = len(prediction)
        problem = StepProblem(
            prediction=grid((prediction - origin) / self._length),
            starts=grid((candidates - origin[:, None]) / self._length),
            forces=grid(forces / units.force).float(),
            stiffness=(stiffness / scale).float(),
            masses=self._grid_masses,
            free=self._free.expand(batch, -1, -1),
            rest_lengths_i=self._rest_i.expand(batch, -1, -1),
            rest_lengths_j=self._rest_j.expand(batch, -1, -1),
        )
        return problem, origin

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


def _candidates(state: State) -> Tensor:
    """Standing still, and the past continued, (B, G, N, 3) [m]."""
    return torch.stack((state.positions, *extrapolations(state.positions, state.past)), 1)


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
