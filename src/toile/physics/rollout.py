"""The only time loop: sub-steps within frames, warm starts, failure reports."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from toile.physics.frame_steps import FrameSteps
from toile.physics.material import Material
from toile.physics.simulator import SimulationError, Simulator, StepResult, StepStatus
from toile.physics.state import State


@dataclass(frozen=True)
class Rollout:
    """A simulated motion.

    Attributes:
        positions: (B, F, N, 3) [m], frame 0 is the initial state.
        frame_steps: which sub-steps lie between which frames.
        all_positions: (B, n + 1, N, 3) [m], after every one of n sub-steps, detached; a later warm start.
        steps: the step results, where they were asked for.
    """

    positions: Tensor
    frame_steps: FrameSteps
    all_positions: Tensor
    steps: list[StepResult] = field(default_factory=list)

    @property
    def newton_iterations(self) -> int:
        """Sum over all steps and scenes."""
        return sum(sum(step.iterations) for step in self.steps)


def rollout(
    simulator: Simulator,
    state: State,
    material: Material,
    forces: Tensor,
    boundary: Tensor,
    substeps: int | FrameSteps,
    warm_start: Tensor | None = None,
    *,
    linearize: bool = False,
    throw: bool = True,
) -> Rollout:
    """Simulate F - 1 frames from an initial state.

    Args:
        simulator: its time step is one sub-step.
        state: at frame 0, batch B.
        material: stiffnesses (B,).
        forces: external force per frame 1 ... F-1, constant over its sub-steps, (B, F-1, N, 3) [N].
        boundary: positions of pinned vertices at every frame, (B, F, n_pinned, 3) [m]; linear in between.
        substeps: sub-steps per frame, or which lie between which frames.
        warm_start: all_positions of an earlier, similar rollout; may be shorter.
        linearize: keep the derivatives of every step.
        throw: raise SimulationError where a step does not converge; otherwise its status tells.
    """
    n_frames = forces.shape[1] + 1
    if boundary.shape[1] != n_frames:
        raise ValueError(
            f"boundary positions: expected {n_frames} frames as given by the forces, got {boundary.shape[1]}"
        )
    frame_steps = FrameSteps.regular(substeps, n_frames) if isinstance(substeps, int) else substeps
    if frame_steps.n_frames != n_frames:
        raise ValueError(
            f"substeps: expected {n_frames} frames as given by the forces, got {frame_steps.n_frames}"
        )
    frames = [state.positions]
    every = [state.positions.detach()]
    steps: list[StepResult] = []
    correction: Tensor | None = None
    for frame in range(1, n_frames):
        before, between = frame_steps.ends[frame - 1], frame_steps.between(frame - 1)
        for sub in range(1, between + 1):
            n = before + sub
            fraction = sub / between
            target = (
                boundary[:, frame]
                if sub == between
                else torch.lerp(boundary[:, frame - 1], boundary[:, frame], fraction)
            )
            guess = None
            if warm_start is not None and n < warm_start.shape[1]:
                guess = warm_start[:, n] if correction is None else warm_start[:, n] + correction
            result = simulator.step(state, material, forces[:, frame - 1], target, guess, linearize=linearize)
            state = result.state
            if throw and any(s is not StepStatus.CONVERGED for s in result.status):
                raise SimulationError(_explain(frame, sub, between, result))
            every.append(state.positions.detach())
            if guess is not None and warm_start is not None:
                # The motion has moved away from the earlier one by about this much; so will the next step.
                correction = every[-1] - warm_start[:, n]
            steps.append(result)
        frames.append(state.positions)
    return Rollout(torch.stack(frames, 1), frame_steps, torch.stack(every, 1), steps)


def _explain(frame: int, sub: int, substeps: int, result: StepResult) -> str:
    scene = next(i for i, s in enumerate(result.status) if s is not StepStatus.CONVERGED)
    return (
        f"simulation failed at frame {frame}, sub-step {sub} of {substeps}, scene {scene} of the batch: "
        f"{result.status[scene].value} (out-of-balance force {result.residual[scene]:.3g} N after "
        f"{result.iterations[scene]} iterations). Try more sub-steps per frame, softer materials or smaller "
        "forces."
    )
