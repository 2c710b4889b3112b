"""One implicit step as minimisation of the incremental potential, by Newton's method.

    Φ(x) = ½ ‖x - x̂‖²_M / (β h)² + E(x) - <f, x> + U(x)

| symbol | meaning | shape, unit |
|---|---|---|
| x̂ | prediction of the integrator from past positions | (N, 3) m |
| M | vertex masses | (N,) kg |
| β h | effective step | s |
| E | internal energy Σ_c k_c e_c | J |
| f | external force | (N, 3) N |
| U | whatever else acts within the step, if anything | J |

The exact Hessian gives quadratic convergence, and its factor serves further steps as long as each of them
halves the residual: such a step costs a tenth of a factorisation. Where the exact Hessian is not positive
definite, it is blended with the one without indefinite parts (projection), as little as makes it so: full
projection is slow out of a buckling instability, a multiple of the inertia is slow into the minimum.
Where the line search fails, a growing multiple of the inertia is added on top.
Convergence is measured as out-of-balance force against the weight of the cloth.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toile.limits import Count, CountOrZero, Positive
from toile.physics.implicit.assembly import Assembly
from toile.physics.implicit.linear_solvers.base import Factor, LinearSolver
from toile.physics.implicit.potential import StepPotential
from toile.physics.implicit.terms import TermMemory
from toile.physics.simulator import StepStatus

Array = NDArray[np.float64]

_log = logging.getLogger(__name__)

# Levels of regularisation: the share of the projected Hessian in the blend, then multiples of the inertia.
_PROJECTED_SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)
_INERTIA_GROWTH = 4.0
_MAX_LEVEL = len(_PROJECTED_SHARES) + 20

# Rounding errors of x - x̂, as a multiple of the largest coordinate.
_ROUNDING = 4 * float(np.finfo(np.float64).eps)

# A factor is used again as long as the largest residual shrinks at least to this fraction.
_REUSE_RATIO = 0.5


@dataclass(frozen=True)
class NewtonSettings:
    """Settings of the minimisation.

    Attributes:
        tolerance: largest out-of-balance force on a vertex as a fraction of an interior vertex's weight at
            1 g; the equation is solved to this accuracy, or to rounding where that is coarser.
        max_iterations: Newton iterations, each with a new Hessian, before the step is given up.
        max_halvings: step halvings of the back-tracking line search.
    """

    tolerance: Positive = 1e-6
    max_iterations: Count = 60
    max_halvings: CountOrZero = 12


@dataclass(frozen=True)
class Linearization:
    """Derivatives of one step at its solution, in the vertices' own order unless stated.

    Attributes:
        factor: Cholesky factor of the Hessian of Φ over the free vertices.
        coupling: (3 n_pinned, 3N) ∂²E/∂x_pinned∂x_free.
        unit_gradients: (C, N, 3) gradients of the unit energies e_c.
        inertia: (N,) masses / (β h)².
        exact: whether the Hessian is the exact one at the solution. If not, the derivatives are approximate:
            the solution is a saddle, or the factor was made on the way to it.
        memory: how the step terms depend on the past, if there are any.
    """

    factor: Factor
    coupling: Array
    unit_gradients: Array
    inertia: Array
    exact: bool = True
    memory: TermMemory | None = None


@dataclass(frozen=True)
class StepSolution:
    """Solution of one step of one scene.

    Attributes:
        positions: x_{n+1} (N, 3) [m].
        status: see StepStatus.
        iterations: Newton iterations.
        residual: largest out-of-balance force [N].
        linearization: if it was asked for.
        factor: the last one that served, where it was asked for and is that of an exact Hessian.
    """

    positions: Array
    status: StepStatus
    iterations: int
    residual: float
    linearization: Linearization | None
    factor: Factor | None = None


def minimise_incremental_potential(
    assembly: Assembly,
    solver: LinearSolver,
    guesses: Array,
    prediction: Array,
    boundary: Array,
    forces: Array,
    stiffness: Array,
    inertia: Array,
    force_scale: float,
    settings: NewtonSettings,
    *,
    linearize: bool,
    fresh_linearization: bool = True,
    extra: StepPotential | None = None,
    factor: Factor | None = None,
    keep_factor: bool = False,
) -> StepSolution:
    """Minimise Φ over the free vertices.

    Args:
        assembly: internal energy of the cloth.
        solver: for matrices of its pattern.
        guesses: (G, N, 3) candidate starts [m]; the one of lowest Φ is taken.
        prediction: x̂ (N, 3) [m].
        boundary: positions of the pinned vertices (n_pinned, 3) [m].
        forces: f (N, 3) [N].
        stiffness: (C,) coefficients of the energies.
        inertia: masses / (β h)², (N,) [kg/s²].
        force_scale: force that ``tolerance`` is relative to [N].
        settings: see NewtonSettings.
        linearize: also return the derivatives at the solution.
        fresh_linearization: with a Hessian of their own. If not, that of the last iteration serves once more
            where it is the exact one; it was made where the iteration began.
        extra: U; none if None.
        factor: of the exact Hessian of a similar step, tried before one is made.
        keep_factor: return the last one made for the next such step.
    """
    free = assembly.free
    # No force is known better than the rounding of the inertial one; a tolerance below is out of reach.
    attainable = _ROUNDING * float(inertia.max(initial=0.0)) * float(np.abs(prediction).max(initial=0.0))
    threshold = max(settings.tolerance * force_scale, attainable)

    def residual_of(unit_gradients: Array, at: Array) -> Array:
        internal = np.tensordot(stiffness, unit_gradients, 1)
        if extra is not None:
            internal = internal + extra.gradient(at)
        return (inertia[:, None] * (at - prediction) + internal - forces) * free

    def potential(at: Array) -> float:
        away = at - prediction
        kinetic = 0.5 * float((inertia[:, None] * away * away * free).sum())
        total = kinetic + float(stiffness @ assembly.energies(at)) - float((forces * at * free).sum())
        return total if extra is None else total + extra.total(at, free)

    def rounding(before: float, after: float) -> bool:
        """Whether a difference of Φ drowns in rounding, as it does close to the minimum."""
        return abs(after - before) <= 1e-12 * (abs(before) + abs(after))

    starts = np.array(guesses, np.float64)
    starts[:, assembly.pinned] = boundary
    # Where tangents lead a guess may be anywhere.
    with np.errstate(over="ignore", invalid="ignore"):
        values = np.array([potential(start) for start in starts])
    best = int(np.argmin(np.where(np.isfinite(values), values, np.inf)))
    x, value = starts[best], float(values[best])
    unit_gradients = assembly.gradients(x)
    residual = residual_of(unit_gradients, x)
    blocks: Array | None = None
    level = 0
    iteration = 0
    status = StepStatus.CONVERGED

    def reuse(factor: Factor) -> None:
        """Step with this factor as long as every step shrinks the residual."""
        nonlocal x, value, unit_gradients, residual
        while (worst := float(np.abs(residual).max())) > threshold:
            trial = x - factor.solve(residual)
            trial_gradients = assembly.gradients(trial)
            trial_residual = residual_of(trial_gradients, trial)
            if not np.abs(trial_residual).max() <= _REUSE_RATIO * worst:
                break
            trial_value = potential(trial)
            if not (trial_value <= value or rounding(value, trial_value)):
                break
            x, value, unit_gradients, residual = trial, trial_value, trial_gradients, trial_residual

    kept = factor
    if factor is not None:
        reuse(factor)
    while True:
        worst = float(np.abs(residual).max(initial=0.0))
        if not np.isfinite(worst) or not np.isfinite(value):
            return StepSolution(x, StepStatus.NOT_FINITE, iteration, float("nan"), None)
        if worst <= threshold:
            break
        if iteration >= settings.max_iterations:
            status = StepStatus.MAX_ITERATIONS
            break
        iteration += 1
        factor, blocks, level = _regularised_factor(assembly, solver, x, stiffness, inertia, level, extra)
        kept = None if blocks is None else factor
        if factor is None:
            status = StepStatus.LINE_SEARCH_FAILED
            break
        direction = -factor.solve(residual)
        slope = float((residual * direction).sum())
        length = 1.0
        for _ in range(settings.max_halvings):
            trial = x + length * direction
            trial_value = potential(trial)
            if trial_value <= value + 1e-4 * length * slope:
                break
            if rounding(value, trial_value):
                trial_residual = residual_of(assembly.gradients(trial), trial)
                if np.abs(trial_residual).max() < worst:
                    break
            length *= 0.5
        else:
            level = max(level + 1, len(_PROJECTED_SHARES))
            if level > _MAX_LEVEL:
                status = StepStatus.LINE_SEARCH_FAILED
                break
            continue
        x, value, unit_gradients = trial, trial_value, assembly.gradients(trial)
        residual = residual_of(unit_gradients, x)
        if level == 0 and length == 1.0:
            reuse(factor)
        level = max(min(level, len(_PROJECTED_SHARES) - 1) - 1, 0)
    linearization = None
    if linearize and not fresh_linearization and factor is not None and blocks is not None:
        linearization = Linearization(factor, assembly.coupling(blocks), unit_gradients, inertia, exact=False)
    elif linearize:
        linearization = linearise(assembly, solver, x, unit_gradients, stiffness, inertia, extra)
    largest = float(np.abs(residual).max(initial=0.0))
    return StepSolution(x, status, iteration, largest, linearization, kept if keep_factor else None)


def _regularised_factor(
    assembly: Assembly,
    solver: LinearSolver,
    x: Array,
    stiffness: Array,
    inertia: Array,
    level: int,
    extra: StepPotential | None,
) -> tuple[Factor | None, Array | None, int]:
    """Factor of the Hessian of Φ at the first level of regularisation, from ``level`` on, that allows one.

    The blocks of E + U come with it where the level is 0: the exact Hessian.
    """
    exact = potential_hessian(assembly, x, stiffness, extra, convex=False)
    if level == 0:
        factor = solver.factorise(exact, inertia)
        if factor is not None:
            return factor, exact, 0
        level = 1
    added = potential_hessian(assembly, x, stiffness, extra, convex=True)
    added -= exact
    blocks = np.empty_like(exact)
    while level <= _MAX_LEVEL:
        beyond = level - len(_PROJECTED_SHARES)
        share = 1.0 if beyond >= 0 else _PROJECTED_SHARES[level]
        damping = _INERTIA_GROWTH**beyond if beyond >= 0 else 0.0
        np.multiply(added, share, out=blocks)
        blocks += exact
        factor = solver.factorise(blocks, inertia * (1 + damping))
        if factor is not None:
            return factor, None, level
        level += 1
    return None, None, level


def potential_hessian(
    assembly: Assembly, x: Array, stiffness: Array, extra: StepPotential | None, *, convex: bool
) -> Array:
    """Blocks of the Hessian of E + U, see Assembly.hessian."""
    _, blocks = assembly.hessian(x, stiffness, convex=convex)
    if extra is not None:
        extra.add_hessian(blocks, assembly.pattern, x, convex=convex)
    return blocks


def linearise(
    assembly: Assembly,
    solver: LinearSolver,
    x: Array,
    unit_gradients: Array,
    stiffness: Array,
    inertia: Array,
    extra: StepPotential | None = None,
) -> Linearization:
    """Derivatives at x with the exact Hessian.

    At a point that is no strict minimum (a saddle: cloth about to buckle) the projected Hessian takes its
    place; the result is then not the derivative, says so in ``exact`` and is logged as a warning.

    Raises:
        FloatingPointError: not even the projected Hessian is positive definite.
    """
    for exact in (True, False):
        blocks = potential_hessian(assembly, x, stiffness, extra, convex=not exact)
        factor = solver.factorise(blocks, inertia)
        if factor is not None:
            if not exact:
                _log.warning("a step ended at a saddle of its potential: its derivatives are approximate")
            return Linearization(factor, assembly.coupling(blocks), unit_gradients, inertia, exact)
    raise FloatingPointError("the Hessian is not positive definite even without its indefinite parts")
