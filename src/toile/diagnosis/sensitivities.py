"""Change of a whole motion for hundreds of forces at once.

Around a motion that is already known, the equations of all sub-steps are linear in the forces. Their Hessians
are assembled and factorised once, and the forces of every unknown run through them in one sweep over time, as
dense blocks: five hundred unknowns cost about as much as the fit of one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from scipy.linalg import lapack

from toile.diagnosis.past_forces import PastForces, PastOfStep
from toile.limits import Fraction
from toile.physics.implicit.linear_solvers.banded import BandedCholesky, BandedSolver
from toile.physics.implicit.newton import potential_hessian
from toile.physics.implicit.terms import SceneTerms
from toile.physics.linearizable import LinearizableSimulator
from toile.physics.material import Material
from toile.physics.step_terms import StepContext

Array = NDArray[np.float64]
Single = NDArray[np.float32]


@dataclass(frozen=True)
class TangentSettings:
    """How fast a change may grow.

    Before snap-through buckling changes grow without bounds and no tangent holds for long. Then the
    smallest share of a convex Hessian is taken with which they are not faster than this.

    Attributes:
        fastest: growth of a change in one sub-step that is followed.
        convex: shares of the convex Hessian that are tried in this order; the last one is taken if none does.
    """

    fastest: Annotated[float, Field(gt=1, allow_inf_nan=False)] = 5.0
    convex: Annotated[tuple[Fraction, ...], Field(min_length=1)] = (0.0, 0.1, 0.25, 0.5, 0.75, 1.0)


DEFAULT = TangentSettings()


@dataclass(frozen=True)
class StepForces:
    """What acted in one sub-step of a known motion.

    Attributes:
        index: of the sub-step, from 0.
        positions: at its end (N, 3) [m].
        before: at its begin (N, 3) [m].
        velocities: at its begin (N, 3) [m/s].
        unit_gradients: of the unit energies at its end (C, N, 3).
        imbalance: inertia (x - x̂), (N, 3) [N].
    """

    index: int
    positions: Array
    before: Array
    velocities: Array
    unit_gradients: Array
    imbalance: Array


@dataclass(frozen=True)
class LoadSensitivities:
    """Derivatives of what drives one sub-step by R unknowns: right-hand sides of the tangent equations.

    Attributes:
        forces: (n_active, N, 3) [N]; those of the unknowns beyond are still zero.
        boundary: displacement of the pinned vertices at its end (n_active, n_pinned, 3) [m].
    """

    forces: Array
    boundary: Array


class BlockFactor:
    """Band Cholesky factor as dense blocks, for many right-hand sides: matrix products only."""

    def __init__(self, factor: BandedCholesky) -> None:
        n, width = factor.band.shape
        self.n, self.size = n, width - 1
        places = _block_places(n, width)
        # One beyond is 0, and the one after that is 1, on the diagonal of rows that fill the last block.
        band = np.concatenate((factor.band.reshape(-1), (0.0, 1.0)))
        self._below: list[Single] = list(band[places.below].astype(np.float32))
        self._inverse: list[Single] = []
        for diagonal in band[places.diagonal]:
            # In LAPACK's order it is its transpose.
            inverse, info = lapack.dtrtri(diagonal.T, lower=1)
            if info != 0:
                raise FloatingPointError("a factor of the Hessian is singular")
            self._inverse.append(inverse.astype(np.float32))

    def solve(self, right: Single) -> Single:
        """Solve for right-hand sides (n, R)."""
        size = self.size
        parts: list[Single] = []
        for b, inverse in enumerate(self._inverse):
            r = right[b * size : (b + 1) * size]
            if len(r) < size:
                r = np.concatenate((r, np.zeros((size - len(r), r.shape[1]), np.float32)))
            if b:
                r = r - self._below[b - 1] @ parts[-1]
            parts.append(inverse @ r)
        for b in range(len(parts) - 1, -1, -1):
            r = parts[b]
            if b + 1 < len(parts):
                r = r - self._below[b].T @ parts[b + 1]
            parts[b] = self._inverse[b].T @ r
        return np.concatenate(parts)[: self.n]


@dataclass(frozen=True)
class _BlockPlaces:
    """Where the entries of dense blocks stand in a band, those beyond it at its end.

    Attributes:
        diagonal: of the lower triangular blocks, transposed (blocks, size, size).
        below: of those below them, but for the last (blocks - 1, size, size).
    """

    diagonal: NDArray[np.intp]
    below: NDArray[np.intp]


@lru_cache(maxsize=8)
def _block_places(n: int, width: int) -> _BlockPlaces:
    """For a band (n, width): row k holds column k of the factor from its diagonal down."""
    size = width - 1
    blocks = -(-n // size)
    block, row, column = np.ogrid[:blocks, :size, :size]
    row, column = block * size + row, block * size + column

    def of(below: NDArray[np.intp]) -> NDArray[np.intp]:
        """Of the entries so many rows below the diagonal, in these columns."""
        inside = (below >= 0) & (below < width) & (column + below < n)
        return np.where(inside, column * width + below, n * width)

    diagonal = of(row - column)
    diagonal[(row == column) & (row >= n)] = n * width + 1
    return _BlockPlaces(diagonal.transpose(0, 2, 1).copy(), of(row + size - column)[:-1])


@lru_cache(maxsize=4)
def _of_all_steps(simulator: LinearizableSimulator) -> tuple[BandedSolver, PastForces | None]:
    """What is the same in all motions by a simulator."""
    # The dense blocks that many right-hand sides are solved with are made of a band.
    solver = BandedSolver(simulator.assembly.pattern, simulator.assembly.pinned)
    terms, cloth = simulator.terms, simulator.cloth
    return solver, PastForces(terms, cloth) if terms and cloth.grid is not None else None


class KnownMotion:
    """A motion sub-step by sub-step, with what its equations need.

    Args:
        simulator: cloth, time step, integrator and step terms.
        positions: of all sub-steps (S + 1, N, 3) [m].
        material: (P,) what the cloth's law depends on, in SI units.
        past: positions before the first one, latest first (K, N, 3) [m]; None: at rest.
        steps: taken before; multistep methods begin with formulas of their own.
        past_step: between the positions before the first one [s]; None: the time step.
        settings: of the tangents.
        began: when the first of the steps taken before began, since frame 0 [s].
    """

    def __init__(
        self,
        simulator: LinearizableSimulator,
        positions: Array,
        material: Array,
        past: Array | None = None,
        steps: int = 0,
        past_step: float | None = None,
        settings: TangentSettings = DEFAULT,
        began: float = 0.0,
    ) -> None:
        self.simulator = simulator
        self.began = began
        self.settings = settings
        self.past_step = simulator.time_step if past_step is None else past_step
        self.positions = positions
        energies = simulator.cloth.energies
        self.material = Material(
            energies.parameters, torch.from_numpy(np.asarray(material, np.float64))[None]
        )
        self.stiffness = energies.coefficients(self.material.values)[0].numpy()
        self.n_steps = len(positions) - 1
        k = simulator.integrator.history
        before = np.repeat(positions[:1], k - 1, 0) if past is None else past[: k - 1][::-1]
        self._padded = np.concatenate((before, positions))
        self._history = k
        self._before = steps
        terms, grid = simulator.terms, simulator.cloth.grid
        self._scene = SceneTerms()
        self._solver, self._past_forces = _of_all_steps(simulator)
        self._of_past: list[PastOfStep] = []
        if terms and grid is None:
            raise ValueError("tangents with step terms: expected a cloth on a grid")

    def coefficients(self, n: int) -> tuple[tuple[float, ...], Array]:
        """Weights of the prediction and inertia (N,) of sub-step n."""
        formula = self.simulator.integrator.formula(self._before + n)
        return formula.prediction, self.simulator._inertia(formula)

    def context(self, n: int) -> StepContext:
        """What was known when sub-step n began."""
        simulator = self.simulator
        return StepContext(
            cloth=simulator.cloth,
            material=self.material,
            positions=torch.from_numpy(self.positions[n]),
            velocities=torch.from_numpy(self._velocity(n)),
            time=self.began + (self._before + n + 1) * simulator.time_step,
            time_step=simulator.time_step,
            boundary=torch.from_numpy(self.positions[n + 1][simulator.assembly.pinned]),
        )

    def step(self, n: int) -> StepForces:
        """What acted in sub-step n; the assembly has its elements afterwards."""
        if self.simulator.terms:
            self._scene = SceneTerms.of(self.simulator.terms, self.context(n))
            self._scene.prepare(self.simulator.assembly)
        weights, inertia = self.coefficients(n)
        k = self._history
        prediction = np.zeros_like(self.positions[0])
        for i, c in enumerate(weights):
            prediction += c * self._padded[n + k - 1 - i]
        x = self.positions[n + 1]
        return StepForces(
            n,
            x,
            self.positions[n],
            self._velocity(n),
            self.simulator.assembly.gradients(x),
            inertia[:, None] * (x - prediction),
        )

    def _velocity(self, n: int) -> Array:
        """Velocity (N, 3) [m/s] at the begin of sub-step n, as the simulator has it."""
        steps = self._before + n
        if steps == 0:
            return np.zeros_like(self.positions[0])
        weights = self.simulator.integrator.formula(steps - 1).velocity
        at = n + self._history - 1
        total = sum(d * self._padded[max(at - i, 0)] for i, d in enumerate(weights))
        return np.asarray(total / self.simulator.time_step)

    def required(self, step: StepForces) -> Array:
        """External force that makes the motion what it is (N, 3) [N]; zero at pinned vertices."""
        free = self.simulator.assembly.free
        return np.asarray(free * (step.imbalance + np.tensordot(self.stiffness, step.unit_gradients, 1)))

    def tangents(
        self,
        first: int,
        last: int,
        substeps: int,
        loads: Callable[[StepForces], LoadSensitivities],
        start: Array,
        velocities: Array,
        substep_changes: list[Single] | None = None,
    ) -> Iterator[tuple[Single, Single]]:
        """Change of the frames first + 1 ... last for every unknown, vertices' own order.

        Positions (3N, R) [m] and velocities [m/s] of each.

        Args:
            first: frame whose state changes as ``start`` and ``velocities`` say.
            last: frame.
            substeps: sub-steps per frame.
            loads: right-hand sides of a sub-step; the number of active ones never falls.
            start: change of the positions at ``first`` (R, N, 3) [m].
            velocities: of the velocities there (R, N, 3) [m/s].
            substep_changes: is given the change of the positions of every sub-step (3N, R), if not None.
        """
        assembly = self.simulator.assembly
        pinned = assembly.pinned
        order = np.argsort(self._solver.order)
        x0, v0 = (a.reshape(len(a), -1).T.astype(np.float32) for a in (start, velocities))
        zero = np.zeros_like(x0)
        h = self.simulator.time_step
        history = [x0 - np.float32(i * self.past_step) * v0 for i in range(self._history)]
        speed = v0
        free = assembly.free.reshape(-1)[:, None].astype(np.float32)
        pinned_rows = (3 * pinned[:, None] + np.arange(3)).reshape(-1)
        for n in range(first * substeps, last * substeps):
            weights, inertia = self.coefficients(n)
            step = self.step(n)
            factor, coupling = self._factor(step.positions, inertia)
            right = loads(step)
            m = len(right.forces)
            b = right.forces.reshape(m, -1).T.astype(np.float32)
            mass = np.repeat(inertia, 3)[:, None].astype(np.float32)
            predicted = sum(np.float32(c) * y[:, :m] for c, y in zip(weights, history, strict=True))
            b += mass * predicted
            past = self._past_forces
            if past is not None and past.remember:
                b += self._past(n).change(history[0][:, :m], speed[:, :m])
            boundary = right.boundary.reshape(m, -1).astype(np.float32)
            b -= coupling.T.astype(np.float32) @ boundary.T
            b *= free
            x = np.empty_like(zero)
            x[:, m:] = 0
            solved = factor.solve(np.ascontiguousarray(b[order]))
            x[order, :m] = solved
            x[pinned_rows, :m] = boundary.T
            history = [x, *history[:-1]]
            if substep_changes is not None:
                substep_changes.append(x)
            ends = (n + 1) % substeps == 0
            if ends or (past is not None and past.remember):
                formula = self.simulator.integrator.formula(self._before + n)
                total = sum(np.float32(d) * y for d, y in zip(formula.velocity, history, strict=False))
                speed = np.asarray(total / np.float32(h), np.float32)
            if ends:
                yield x, speed

    def _past(self, n: int) -> PastOfStep:
        if not self._of_past:
            remember([self])
        return self._of_past[n]

    def _factor(self, x: Array, inertia: Array) -> tuple[BlockFactor, Array]:
        assembly = self.simulator.assembly
        extra = self._scene.vertices
        exact = potential_hessian(assembly, x, self.stiffness, extra, convex=False)
        convex: Array | None = None
        for share in self.settings.convex:
            blocks = exact
            if share > 0:
                if convex is None:
                    convex = potential_hessian(assembly, x, self.stiffness, extra, convex=True)
                blocks = (1 - share) * exact + share * convex
            slower = (1 - 1 / self.settings.fastest) * inertia
            if share == self.settings.convex[-1] or self._solver.factorise(blocks, slower) is not None:
                break
        factor = self._solver.factorise(blocks, inertia)
        if factor is None:
            raise FloatingPointError("the Hessian is not positive definite without its indefinite parts")
        return BlockFactor(factor.cholesky), assembly.coupling(exact)


def remember(motions: Sequence[KnownMotion]) -> None:
    """Find how the forces of all steps of motions hang on what was before, side by side.

    Args:
        motions: by one simulator, of one material.
    """
    forces = motions[0]._past_forces if motions else None
    if forces is None:
        return
    steps = [
        (motion.context(n), motion.positions[n + 1]) for motion in motions for n in range(motion.n_steps)
    ]
    found = iter(forces.of_steps(steps))
    for motion in motions:
        motion._of_past = [next(found) for _ in range(motion.n_steps)]
