"""Gauss-Newton on one window of frames, through the simulator.

    J(z) = ½ |z|² + image term(x(z)),    (I + Jᵀ A J) s = -(z + Jᵀ g)

z are the standardised unknowns, x(z) the simulated motion, A and g the image term's Gauss-Newton matrix and
gradient, J the Jacobian of the motion. J is never formed: conjugate gradients need one tangent and one
adjoint rollout per iteration, both from the factorisations that the simulation has left behind.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from toile.physics.implicit.linearized import LinearizedRollout
from toile.physics.linearizable import LinearizableSimulator
from toile.physics.rollout import Rollout, rollout
from toile.physics.simulator import StepStatus
from toile.physics.state import State
from toile.reconstruction.gauss_newton import conjugate_gradients
from toile.reconstruction.gauss_newton.conjugate_gradients import Vector, axpy, dot
from toile.reconstruction.gauss_newton.unknowns import WindowUnknowns
from toile.reconstruction.image_terms.texture_points import PointTermValue, TexturePointTerm
from toile.reconstruction.image_terms.tracked_positions import TrackedPositionTerm
from toile.reconstruction.problem import Reconstruction

Array = NDArray[np.float64]

# Step lengths of the back-tracking line search.
_BACKTRACK = 0.35
_MAX_TRIALS = 4
# A window is left when an iteration lowers J by less than this fraction.
_STALLED = 3e-3


@dataclass
class WindowResult:
    """Outcome of a window.

    Attributes:
        objective: J at the end.
        colour, mask: image term at the end, per frame.
        positions: at the window's start and after all of its n sub-steps (n + 1, N, 3) [m].
        iterations: accepted Gauss-Newton iterations.
        conjugate_gradients: iterations of the linear solver, summed.
        newton: Newton iterations of the simulator, summed.
        notes: messages for the log.
    """

    objective: float
    colour: Array
    mask: Array
    positions: Array
    iterations: int
    conjugate_gradients: int
    newton: int
    notes: list[str]


@dataclass(frozen=True)
class Motion:
    """A simulated window.

    Attributes:
        simulator: that made it.
        start: state it began with.
        rollout: batch of one.
    """

    simulator: LinearizableSimulator
    start: State
    rollout: Rollout

    @property
    def positions(self) -> Array:
        """Of the frames (n + 1, N, 3) [m]."""
        return np.asarray(self.rollout.positions[0].numpy())

    def linearized(self, *, with_inertia: bool) -> LinearizedRollout:
        """Its derivatives, by masses and time step too if asked for."""
        return LinearizedRollout(self.simulator, self.rollout, start=self.start if with_inertia else None)


@torch.no_grad()
def state_at(reconstruction: Reconstruction, substep_positions: Array | None, frame: int) -> State:
    """State at a frame: the start of the clip, or the stored positions up to that frame."""
    if frame == 0 or substep_positions is None:
        return reconstruction.initial_state()
    simulator = reconstruction.simulator
    index = reconstruction.frame_steps.ends[frame]
    past = torch.from_numpy(
        np.stack([substep_positions[max(index - k, 0)] for k in range(simulator.n_past + 1)])
    )
    # Simulators of implicit steps read the past positions; velocities are for the effects.
    velocity = (past[0] - past[1]) / simulator.time_step
    if len(reconstruction.effects) and isinstance(simulator, LinearizableSimulator):
        weights = torch.tensor(simulator.integrator.formula(index - 1).velocity, dtype=past.dtype)
        velocity = torch.tensordot(weights, past[: len(weights)], 1) / simulator.time_step
    return State(past[0][None], velocity[None], past[None, 1:], index, past.new_zeros(1))


@torch.no_grad()
def minimise_window(
    reconstruction: Reconstruction,
    unknowns: WindowUnknowns,
    term: TexturePointTerm | TrackedPositionTerm,
    visibility: Callable[[Array], NDArray[np.float32]] | None,
    start: State,
    warm_start: Array | None,
    *,
    iterations: int,
    cg_iterations: int,
    cg_tolerance: float,
) -> WindowResult:
    """Lower J by a few Gauss-Newton iterations and write the result into the parameters.

    Args:
        reconstruction: see Reconstruction; its simulator must be a LinearizableSimulator.
        unknowns: free parameters of the window.
        term: what the motion is compared with.
        visibility: frame positions (n, N, 3) -> visible points (n, P), or None if all are.
        start: state at the window's first frame.
        warm_start: sub-step positions of an earlier simulation of the window.
        iterations: Gauss-Newton iterations at most.
        cg_iterations: iterations of the linear solver at most.
        cg_tolerance: its residual relative to the gradient.
    """
    first = unknowns.first
    frame_steps = reconstruction.frame_steps.window(first, unknowns.last)
    nominal = reconstruction.simulator
    newton = 0

    def simulate(z: Vector, guess: Array | None, *, linearize: bool) -> tuple[Motion, bool]:
        nonlocal newton
        given = unknowns.inputs(z, linearize=linearize)
        simulator, boundary = given.simulator, given.boundary
        if not isinstance(simulator, LinearizableSimulator):
            raise TypeError(
                f"Gauss-Newton needs a simulator that linearises its steps, got {type(simulator).__name__}"
            )
        state = start
        if first == 0:
            positions = start.positions.clone()
            positions[0, simulator.cloth.pinned] = torch.from_numpy(boundary[0])
            state = State.start(positions, start.velocities, simulator.time_step, simulator.n_past)
        elif simulator.time_step != nominal.time_step:
            # The positions before are what they are; another clock makes other velocities of them.
            state = replace(start, velocities=start.velocities * (nominal.time_step / simulator.time_step))
        result = rollout(
            simulator,
            state,
            unknowns.material(z),
            torch.from_numpy(given.forces)[None],
            torch.from_numpy(boundary)[None],
            frame_steps,
            None if guess is None else torch.from_numpy(guess)[None],
            linearize=linearize,
            throw=False,
        )
        newton += result.newton_iterations
        converged = all(step.status[0] is StepStatus.CONVERGED for step in result.steps)
        return Motion(simulator, state, result), converged

    def evaluate(motion: Motion, seen: NDArray[np.float32] | None, *, derivatives: bool) -> PointTermValue:
        return term.evaluate(motion.positions, first, seen, derivatives=derivatives)

    notes: list[str] = []
    z = unknowns.start()
    motion, converged = simulate(z, warm_start, linearize=True)
    if not converged:
        notes.append(
            f"frames {first}-{unknowns.last}: the solver did not converge at the start of the window"
        )
    accepted = linear_iterations = 0
    value: PointTermValue | None = None
    seen: NDArray[np.float32] | None = None
    objective = np.inf
    for iteration in range(iterations):
        positions = motion.positions
        seen = None if visibility is None else visibility(positions)
        value = evaluate(motion, seen, derivatives=True)
        objective = value.total + 0.5 * dot(z, z)
        linear = motion.linearized(with_inertia=reconstruction.effects.change_inertia)
        full = axpy(1.0, z, unknowns.adjoint(z, linear.adjoint(value.gradient)))
        gradient = unknowns.stopped(z, full, full)

        def hessian(
            d: Vector,
            at: Vector = z,
            jac: LinearizedRollout = linear,
            v: PointTermValue = value,
            slope: Vector = full,
        ) -> Vector:
            change = term.apply(v, jac.tangent(unknowns.tangent(at, d)))
            return unknowns.stopped(at, axpy(1.0, d, unknowns.adjoint(at, jac.adjoint(change))), slope)

        solution = conjugate_gradients.solve(hessian, gradient, cg_iterations, cg_tolerance)
        linear_iterations += solution.iterations
        length = 1.0
        more = iteration + 1 < iterations
        for _ in range(_MAX_TRIALS):
            trial = unknowns.within_bounds(axpy(length, solution.step, z))
            # From the past alone: a step of a buckling cloth has several equilibria, and what is kept must be
            # what the forces give on their own. The linear prediction as a start would halve the iterations.
            try:
                trial_motion, converged = simulate(trial, None, linearize=more)
            except FloatingPointError:
                # Effects can be strong enough to blow up a step.
                length *= _BACKTRACK
                continue
            trial_value = evaluate(trial_motion, seen, derivatives=False)
            trial_objective = trial_value.total + 0.5 * dot(trial, trial)
            if converged and trial_objective < objective:
                break
            length *= _BACKTRACK
        else:
            notes.append(
                f"frames {first}-{unknowns.last}: no step lowered the objective in iteration {iteration + 1}"
            )
            break
        accepted += 1
        stalled = objective - trial_objective < _STALLED * objective
        z, motion, value, objective = trial, trial_motion, trial_value, trial_objective
        if stalled:
            break
    if accepted == 0:
        motion, _ = simulate(z, None, linearize=False)
        value = evaluate(motion, seen, derivatives=False)
        objective = value.total + 0.5 * dot(z, z)
    assert value is not None
    unknowns.write(z)
    return WindowResult(
        objective=float(objective),
        colour=value.colour,
        mask=value.mask,
        positions=motion.rollout.all_positions[0].numpy(),
        iterations=accepted,
        conjugate_gradients=linear_iterations,
        newton=newton,
        notes=notes,
    )
