"""The time step's own error: the same windows with steps of half the length.

It comes first: what a shorter step changes is no effect of the world, and an effect must not be named for it.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from toile.cloth.material import Material
from toile.cloth.state import State
from toile.diagnosis.base_fit import BaseFit
from toile.diagnosis.shooting import Shooting, WindowMotion
from toile.simulators.implicit.simulator import ImplicitSimulator
from toile.simulators.rollout import rollout

Array = NDArray[np.float64]


def time_step_error(shooting: Shooting, fit: BaseFit) -> float:
    """Mean distance [m] between the fitted windows' motion and the same with half the time step.

    Both start from the same positions and velocities, with the same forces and held vertices.
    """
    distances = []
    for window in fit.windows:
        coarse, fine = (_frames(shooting, fit, window, finer) for finer in (1, 2))
        distances.append(np.linalg.norm(coarse - fine, axis=-1).mean(-1)[1:])
    return float(np.concatenate(distances).mean())


@torch.no_grad()
def _frames(shooting: Shooting, fit: BaseFit, window: WindowMotion, finer: int) -> Array:
    """Frames of a window (n + 1, N, 3) [m] with steps so many times shorter."""
    nominal = shooting.simulator
    assert isinstance(nominal, ImplicitSimulator)
    h = nominal.time_step / finer
    simulator = ImplicitSimulator(nominal.cloth, h, nominal.integrator, nominal.newton)
    state, anchors, force = shooting.local(window, window.white)
    # The past of a shorter step, on the parabola through the one there is.
    x, v, H = state.positions, state.velocities, nominal.time_step
    bend = state.past[:, 0] - x + H * v
    times = [(k + 1) * h for k in range(state.past.shape[1])]
    past = torch.stack([x - t * v + (t / H) ** 2 * bend for t in times], 1)
    start = State(x, v, past, state.steps)
    k = torch.from_numpy(fit.base.stiffness)[:, None]
    total = shooting.gravity + fit.base.wind @ shooting.horizontal + force
    motion = rollout(
        simulator,
        start,
        Material(k[0], k[1], k[2]),
        torch.from_numpy(shooting.masses[:, None] * total)[None],
        torch.from_numpy(anchors)[None],
        shooting.substeps * finer,
        throw=False,
    )
    return np.asarray(motion.positions[0].numpy())
