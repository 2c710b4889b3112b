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
        fitted = window.positions[:: shooting.substeps]
        distances.append(np.linalg.norm(_finer(shooting, fit, window) - fitted, axis=-1).mean(-1)[1:])
    return float(np.concatenate(distances).mean())


@torch.no_grad()
def _finer(shooting: Shooting, fit: BaseFit, window: WindowMotion) -> Array:
    """Frames of a window (n + 1, N, 3) [m] with two steps for every one."""
    nominal = shooting.simulator
    assert isinstance(nominal, ImplicitSimulator)
    H = nominal.time_step
    h = H / 2
    simulator = ImplicitSimulator(nominal.cloth, h, nominal.integrator, nominal.newton, nominal.terms)
    state, anchors, force = shooting.local(window, window.white)
    # The past of a shorter step, on the parabola through the one there is.
    x, v = state.positions, state.velocities
    bend = state.past[:, 0] - x + H * v
    times = [(k + 1) * h for k in range(state.past.shape[1])]
    past = torch.stack([x - t * v + (t / H) ** 2 * bend for t in times], 1)
    near = torch.from_numpy(window.positions)
    between = torch.stack((near[:-1], 0.5 * (near[:-1] + near[1:])), 1).flatten(0, 1)
    k = torch.from_numpy(fit.base.stiffness)[:, None]
    total = shooting.gravity + fit.base.wind @ shooting.horizontal + force
    motion = rollout(
        simulator,
        State(x, v, past, state.steps),
        Material(k[0], k[1], k[2]),
        torch.from_numpy(shooting.masses[:, None] * total)[None],
        torch.from_numpy(anchors)[None],
        2 * shooting.substeps,
        torch.cat((between, near[-1:]))[None],
        throw=False,
    )
    return np.asarray(motion.positions[0].numpy())
