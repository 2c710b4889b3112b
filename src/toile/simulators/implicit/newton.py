"""One implicit step as minimisation of the incremental potential, by Newton's method.

    Φ(x) = ½ ‖x - x̂‖²_M / (β h)² + E(x) - <f, x>

| symbol | meaning | shape, unit |
|---|---|---|
| x̂ | prediction of the integrator from past positions | (N, 3) m |
| M | vertex masses | (N,) kg |
| β h | effective step | s |
| E | internal energy Y e_Y + S e_S + B e_B | J |
| f | external force | (N, 3) N |

The exact Hessian gives quadratic convergence. Where its Cholesky factorisation or the line search fails, a
growing multiple of the inertia is added, just enough to make it positive definite: dropping the indefinite
parts instead (projection) was tried and takes ten times as many iterations out of a buckling instability.
Convergence is measured as out-of-balance force against the weight of the cloth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toile.simulators.base import StepStatus
from toile.simulators.implicit.assembly import Assembly
from toile.simulators.implicit.banded import BandedCholesky

Array = NDArray[np.float64]

# Multiples of the inertia added to an indefinite Hessian. Compressed edges need about Y · strain / (m / h²).
_FIRST_DAMPING = 1.0
_DAMPING_GROWTH = 4.0
_MAX_DAMPING = 1e12


@dataclass(frozen=True)
class NewtonSettings:
    """Settings of the minimisation.

    Attributes:
        tolerance: largest out-of-balance force on a vertex as a fraction of an interior vertex's weight at
            1 g; the equation is solved to this accuracy.
        max_iterations: Newton iterations before the step is given up as not converged.
        max_halvings: step halvings of the back-tracking line search.
    """

    tolerance: float = 1e-6
    max_iterations: int = 60
    max_halvings: int = 12


@dataclass(frozen=True)
class Linearization:
    """Derivatives of one converged step at its solution, in the vertices' own order unless stated.

    Attributes:
        factor: Cholesky factor of the Hessian of Φ over the free vertices (band order), identity at held ones.
        coupling: (3 n_held, 3N) ∂²E/∂x_held∂x_free.
        unit_gradients: (3, N, 3) gradients of e_Y, e_S and e_B.
        inertia: (N,) masses / (β h)².
    """

    factor: BandedCholesky
    coupling: Array
    unit_gradients: Array
    inertia: Array


@dataclass(frozen=True)
class StepSolution:
    """Solution of one step of one scene."""

    positions: Array
    status: StepStatus
    iterations: int
    residual: float
    linearization: Linearization | None


def minimise_incremental_potential(
    assembly: Assembly,
    guesses: Array,
    prediction: Array,
    anchors: Array,
    forces: Array,
    stiffness: Array,
    inertia: Array,
    force_scale: float,
    settings: NewtonSettings,
    *,
    linearize: bool,
) -> StepSolution:
    """Minimise Φ over the free vertices.

    Args:
        assembly: internal energy of the cloth.
        guesses: (G, N, 3) candidate starts [m]; the one of lowest Φ is taken.
        prediction: x̂ (N, 3) [m].
        anchors: positions of the held vertices (n_held, 3) [m].
        forces: f (N, 3) [N].
        stiffness: (3,) Y [N/m], S, B [N·m].
        inertia: masses / (β h)², (N,) [kg/s²].
        force_scale: force that ``tolerance`` is relative to [N].
        settings: see NewtonSettings.
        linearize: also return the derivatives at the solution.
    """
    free = assembly.free
    threshold = settings.tolerance * force_scale

    def residual_of(unit_gradients: Array, at: Array) -> Array:
        internal = np.tensordot(stiffness, unit_gradients, 1)
        return (inertia[:, None] * (at - prediction) + internal - forces) * free

    def potential(at: Array) -> float:
        away = at - prediction
        kinetic = 0.5 * float((inertia[:, None] * away * away * free).sum())
        return kinetic + float(stiffness @ assembly.energies(at)) - float((forces * at * free).sum())

    starts = np.array(guesses, np.float64)
    starts[:, assembly.held] = anchors
    values = [potential(start) for start in starts]
    x = starts[int(np.argmin(values))]
    unit_gradients = assembly.gradients(x)
    residual = residual_of(unit_gradients, x)
    value = min(values)
    damping = 0.0
    iteration = 0
    status = StepStatus.CONVERGED
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
        _, exact, _ = assembly.hessian(x, stiffness, convex=False)
        factor = None
        while factor is None and damping <= _MAX_DAMPING:
            band = exact.copy()
            assembly.add_diagonal(band, inertia * (1 + damping))
            factor = BandedCholesky.factorise(band)
            if factor is None:
                damping = max(_DAMPING_GROWTH * damping, _FIRST_DAMPING)
        if factor is None:
            status = StepStatus.LINE_SEARCH_FAILED
            break
        direction = -assembly.from_band(factor.solve(assembly.to_band(residual)))
        slope = float((residual * direction).sum())
        length = 1.0
        for _ in range(settings.max_halvings):
            trial = x + length * direction
            trial_value = potential(trial)
            trial_gradients = assembly.gradients(trial)
            trial_residual = residual_of(trial_gradients, trial)
            # Close to the minimum differences of Φ drown in rounding; there a smaller residual decides.
            lower = trial_value <= value + 1e-4 * length * slope
            rounding = abs(trial_value - value) <= 1e-12 * (abs(value) + abs(trial_value))
            if lower or (rounding and np.abs(trial_residual).max() < worst):
                break
            length *= 0.5
        else:
            damping = max(_DAMPING_GROWTH * damping, _FIRST_DAMPING)
            if damping > _MAX_DAMPING:
                status = StepStatus.LINE_SEARCH_FAILED
                break
            continue
        damping = damping / _DAMPING_GROWTH**2 if damping > _FIRST_DAMPING else 0.0
        x, value, unit_gradients, residual = trial, trial_value, trial_gradients, trial_residual
    linearization = None
    if linearize:
        linearization = linearise(assembly, x, unit_gradients, stiffness, inertia)
    return StepSolution(x, status, iteration, float(np.abs(residual).max(initial=0.0)), linearization)


def linearise(
    assembly: Assembly, x: Array, unit_gradients: Array, stiffness: Array, inertia: Array
) -> Linearization:
    """Derivatives at x with the exact Hessian; the convex one only at a point that is no strict minimum."""
    for convex in (False, True):
        _, band, coupling = assembly.hessian(x, stiffness, convex=convex)
        assembly.add_diagonal(band, inertia)
        factor = BandedCholesky.factorise(band)
        if factor is not None:
            return Linearization(factor, coupling, unit_gradients, inertia)
    raise FloatingPointError("the Hessian is not positive definite even without its indefinite parts")
