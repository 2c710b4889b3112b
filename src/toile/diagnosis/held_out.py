"""What a model predicts beyond the frames it was fitted to: one open rollout, nothing refitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toile.diagnosis.shooting import Base, Shooting, changed_simulation
from toile.effects.base import Effect, Surroundings
from toile.physics.rollout import rollout
from toile.physics.simulator import StepStatus
from toile.physics.state import State

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Prediction:
    """A rollout over held-out frames.

    Attributes:
        positions: (n, N, 3) [m] of frames first + 1 ... first + n.
        errors: root mean square distance to the tracked positions per frame (n,) [m].
        substeps: positions of all sub-steps (1, S + 1, N, 3) [m].
    """

    positions: Array
    errors: Array
    substeps: Tensor


def predict(
    shooting: Shooting,
    around: Surroundings,
    base: Base,
    effects: Sequence[Effect],
    start: State,
    first: int,
    last: int,
    extra: Array | None = None,
    similar: Tensor | None = None,
) -> Prediction | None:
    """Simulate frames first ... last from a state, without free forces; None where the solver fails.

    Args:
        shooting: simulator, tracked positions and boundary positions.
        around: the clip, up to ``last`` at least.
        base: stiffness and wind.
        effects: in the model.
        start: state at ``first``.
        first: frame of the state.
        last: frame.
        extra: constant force per mass beside (N, 3) [m/s²].
        similar: sub-steps of a motion over the same frames to start every step's solver near.
    """
    wind = base.wind @ shooting.horizontal
    simulator, _, forces, boundary = changed_simulation(
        shooting, effects, around, torch.from_numpy(wind if extra is None else wind + extra)
    )
    motion = rollout(
        simulator,
        start,
        base.material_of(simulator.cloth),
        forces[None, first:last],
        boundary[None, first : last + 1],
        shooting.substeps,
        similar,
        throw=False,
    )
    if any(s.status[0] is not StepStatus.CONVERGED for s in motion.steps):
        return None
    positions = motion.positions[0, 1:].detach().numpy()
    errors = shooting.tracked.distances(slice(first + 1, last + 1), positions)
    return Prediction(positions, errors, motion.all_positions)
