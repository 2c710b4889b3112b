"""Tangents and adjoints of a whole rollout from the factorisations that its steps have left behind.

One object serves Gauss-Newton, confidence intervals and sensitivities: after a rollout with
``linearize=True`` a tangent or an adjoint costs one solve per step, about a tenth of the simulation.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray

from toile.physics.implicit.newton import Linearization
from toile.physics.linearizable import LinearizableSimulator
from toile.physics.rollout import Rollout
from toile.physics.state import State

Array = NDArray[np.float64]


@dataclass
class Perturbation:
    """A change of every input of a rollout of one scene, or a gradient with respect to them.

    Pinned vertices are where their boundary positions are, at frame 0 too: ``boundary[0]`` stands for both,
        and what
    ``positions`` and ``velocities`` say about pinned vertices is ignored (zero in a gradient).

    Attributes:
        forces: (F-1, N, 3) [N].
        stiffness: (C,) coefficients of the energies.
        boundary: (F, n_pinned, 3) [m].
        positions: initial positions (N, 3) [m].
        velocities: initial velocities (N, 3) [m/s].
        values: numbers inside the step terms, one term after the other, those that require gradients;
            none is no change.
        inertia: relative change of every vertex's mass over squared time step (N,), beside the forces that
            a mass or a clock changes; none is no change.
    """

    forces: Array
    stiffness: Array
    boundary: Array
    positions: Array
    velocities: Array
    values: Array = field(default_factory=lambda: np.zeros(0))
    inertia: Array = field(default_factory=lambda: np.zeros(0))


class LinearizedRollout:
    """Derivative of the frame positions (F, N, 3) of one scene with respect to all inputs.

    Args:
        simulator: the simulator of the rollout.
        rollout: made with ``linearize=True``.
        scene: index in the batch.
        start: state that the rollout began with; without it derivatives by the inertia are left out. They
            treat what step terms know of masses and time step as given.
    """

    def __init__(
        self, simulator: LinearizableSimulator, rollout: Rollout, scene: int = 0, start: State | None = None
    ) -> None:
        self.simulator = simulator
        self.frame_steps = rollout.frame_steps
        self._intervals = rollout.frame_steps.intervals()
        self.steps: list[Linearization] = [step.linearization[scene] for step in rollout.steps]
        if not self.steps or any(step is None for step in self.steps):
            raise ValueError("expected a rollout made with linearize=True whose every step is finite")
        # A window may begin at a state with a past of its own. That past is fixed then, and the derivatives
        # with respect to the initial positions and velocities treat it as a straight line.
        first = rollout.steps[0].state.steps - 1
        self.n_frames = rollout.frame_steps.n_frames
        self.n_vertices = simulator.cloth.n_vertices
        self._coefficients = [
            simulator.integrator.formula(first + step).prediction for step in range(len(self.steps))
        ]
        # The first step's velocity is the initial one; each later one is made of the positions before.
        self._velocities = [
            simulator.integrator.formula(first + step).velocity for step in range(len(self.steps) - 1)
        ]
        self._h = simulator.time_step
        self._imbalance: list[Array] = []
        if start is not None:
            motion = torch.cat((start.past[scene].flip(0), rollout.all_positions[scene])).detach().numpy()
            k = start.past.shape[1]
            for n, (step, weights) in enumerate(zip(self.steps, self._coefficients, strict=True)):
                away = motion[n + k + 1] - sum(c * motion[n + k - i] for i, c in enumerate(weights))
                self._imbalance.append(step.inertia[:, None] * away)

    @property
    def exact(self) -> bool:
        """Whether every derivative is exact; see Linearization."""
        return all(step.exact for step in self.steps)

    def tangent(self, change: Perturbation) -> Array:
        """Change of the frame positions (F, N, 3) for a change of the inputs, to first order."""
        frames: Array = self.frame_steps.at_frames(self.substep_tangent(change))
        return frames

    def substep_tangent(self, change: Perturbation) -> Array:
        """Change of every sub-step's positions, (n + 1, N, 3), like Rollout.all_positions."""
        assembly = self.simulator.assembly
        free, pinned = assembly.free, assembly.pinned
        start = change.positions.copy()
        start[pinned] = change.boundary[0]
        history = [start - k * self._h * change.velocities for k in range(self.simulator.integrator.history)]
        every = [start]
        moving = bool(np.any(change.boundary))
        for n, step in enumerate(self.steps):
            frame, sub = self._intervals[n]
            right = change.forces[frame] - np.tensordot(change.stiffness, step.unit_gradients, 1)
            if len(change.inertia):
                right -= change.inertia[:, None] * self._imbalance[n]
            prediction = sum(c * x for c, x in zip(self._coefficients[n], history, strict=True))
            right += step.inertia[:, None] * prediction
            if moving:
                fraction = sub / self.frame_steps.between(frame)
                boundary = (1 - fraction) * change.boundary[frame] + fraction * change.boundary[frame + 1]
                right -= (boundary.reshape(-1) @ step.coupling).reshape(-1, 3)
            if step.memory is not None:
                velocity = change.velocities * free
                if n > 0:
                    weights = np.array(self._velocities[n - 1]) / self._h
                    velocity = np.tensordot(weights, np.stack(history[: len(weights)]), 1)
                # Fits run without gradients; these derivatives are made of some.
                with torch.enable_grad():
                    right += step.memory.tangent(
                        history[0],
                        velocity,
                        boundary if moving else np.zeros((len(pinned), 3)),
                        change.stiffness,
                        change.values,
                    )
            x = step.factor.solve(right)
            x[pinned] = boundary if moving else 0.0
            history = [x, *history[:-1]]
            every.append(x)
        return np.stack(every)

    def adjoint(self, gradient: Array) -> Perturbation:
        """Gradient with respect to the inputs for a gradient with respect to frame positions (F, N, 3)."""
        assembly = self.simulator.assembly
        free, pinned = assembly.free, assembly.pinned
        n, k = self.n_vertices, self.simulator.integrator.history
        to = Perturbation(
            np.zeros((self.n_frames - 1, n, 3)),
            np.zeros(assembly.internal.n_coefficients),
            np.zeros((self.n_frames, len(pinned), 3)),
            np.zeros((n, 3)),
            np.zeros((n, 3)),
            np.zeros(0 if self.steps[0].memory is None else self.steps[0].memory.n_values),
            np.zeros(n if self._imbalance else 0),
        )
        # pending[i]: gradient with respect to the position i + 1 steps before the one about to be treated.
        pending = [np.zeros((n, 3)) for _ in range(k)]
        for index in range(len(self.steps) - 1, -1, -1):
            step = self.steps[index]
            frame, sub = self._intervals[index]
            between = self.frame_steps.between(frame)
            g = pending.pop(0)
            if sub == between:
                g = g + gradient[frame + 1]
            adjoint = step.factor.solve(g)
            to.forces[frame] += adjoint
            to.stiffness -= (step.unit_gradients * adjoint).sum((1, 2))
            if self._imbalance:
                to.inertia -= (self._imbalance[index] * adjoint).sum(-1)
            boundary = g[pinned] - (step.coupling @ adjoint.reshape(-1)).reshape(-1, 3)
            pending.append(np.zeros((n, 3)))
            if step.memory is not None:
                to_now, to_velocity, to_boundary, to_stiffness, to_values = step.memory.adjoint(adjoint)
                pending[0] = pending[0] + to_now
                boundary = boundary + to_boundary
                to.stiffness += to_stiffness
                to.values += to_values
                if index > 0:
                    for i, d in enumerate(self._velocities[index - 1]):
                        pending[i] = pending[i] + d / self._h * to_velocity
                else:
                    to.velocities += to_velocity * free
            fraction = sub / between
            to.boundary[frame] += (1 - fraction) * boundary
            to.boundary[frame + 1] += fraction * boundary
            to_prediction = step.inertia[:, None] * adjoint
            for i, c in enumerate(self._coefficients[index]):
                pending[i] = pending[i] + c * to_prediction
        pending[0] = pending[0] + gradient[0]
        for i, g in enumerate(pending):
            start = g.copy()
            to.boundary[0] += start[pinned]
            start[pinned] = 0.0
            to.positions += start
            to.velocities -= i * self._h * start
        return to
