"""The time step's own error: the same windows with steps of half the length, and a fit with steps so short
that shorter ones change nothing.

It comes first: what a shorter step changes is no effect of the world, and an effect must not be named for it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
import torch
from numpy.typing import NDArray

from toile.diagnosis.base_fit import BaseFit, improved
from toile.diagnosis.shooting import Base, Shooting, WindowMotion
from toile.limits import Positive, Unit
from toile.physics.implicit.simulator import ImplicitSimulator
from toile.physics.state import State
from toile.workers import ALONE, Workers

Array = NDArray[np.float64]


@dataclass(frozen=True)
class StepRefinement:
    """When time steps are short enough.

    Attributes:
        tolerance: change of the fitted motion by steps of half the length, over the cloth's width.
        shortest: no step is made shorter [s].
    """

    tolerance: Positive = 0.001
    shortest: Annotated[Positive, Unit("s")] = 0.00125


def time_step_error(shooting: Shooting, fit: BaseFit) -> float:
    """Mean distance [m] between the fitted windows' motion and the same with half the time step.

    Both start from the same positions and velocities, with the same forces and pinned vertices.
    """
    finer = halved(shooting)
    return _distance(shooting, fit.windows, finer, _finer_windows(shooting, finer, fit.windows, fit.base))


def refined(
    shooting: Shooting,
    fit: BaseFit,
    tolerance: float,
    shortest: float,
    report: Callable[[str, float], None],
    workers: Workers = ALONE,
) -> tuple[Shooting, BaseFit]:
    """Steps halved and the base model fitted again until steps of half the length change nothing.

    Args:
        shooting: the problem.
        fit: the base model.
        tolerance: mean distance that is nothing [m].
        shortest: no step is made shorter [s].
        report: called with a message and the cost.
        workers: share the windows.
    """
    while shooting.simulator.time_step / 2 > (1 - 1e-6) * shortest:
        finer = halved(shooting)
        windows = _finer_windows(shooting, finer, fit.windows, fit.base, workers)
        if _distance(shooting, fit.windows, finer, windows) <= tolerance:
            break
        fit = improved(finer, windows, fit.start_material, fit.values, report, workers=workers)
        shooting = finer
    return shooting, fit


def halved(shooting: Shooting) -> Shooting:
    """The problem with two steps for every one."""
    nominal = shooting.simulator
    assert isinstance(nominal, ImplicitSimulator)
    simulator = ImplicitSimulator(
        nominal.cloth, nominal.time_step / 2, nominal.integrator, nominal.newton, nominal.terms
    )
    return Shooting(
        simulator,
        2 * shooting.substeps,
        shooting.gravity,
        shooting.horizontal,
        shooting.grid,
        shooting.boundary,
        shooting.tracked,
        shooting.settings,
    )


def _finer_windows(
    shooting: Shooting,
    finer: Shooting,
    windows: Sequence[WindowMotion],
    base: Base,
    workers: Workers = ALONE,
) -> list[WindowMotion]:
    """Windows with all their unknowns as they are, simulated with steps of half the length."""
    H = shooting.simulator.time_step

    def simulated(window: WindowMotion) -> WindowMotion:
        near = window.positions
        between = np.stack((near[:-1], 0.5 * (near[:-1] + near[1:])), 1).reshape(-1, *near.shape[1:])
        reference = _with_half_past(window.reference, H)
        window = replace(window, reference=reference, positions=np.concatenate((between, near[-1:])))
        return finer.simulate(window, window.standardised, base)

    return list(workers.map(simulated, windows))


def _with_half_past(state: State, H: float) -> State:
    """The state with a past at half the distance H [s], on the parabola through the one there is."""
    x, v = state.positions, state.velocities
    bend = state.past[:, 0] - x + H * v
    times = [(k + 1) * H / 2 for k in range(state.past.shape[1])]
    return replace(state, past=torch.stack([x - t * v + (t / H) ** 2 * bend for t in times], 1))


def _distance(
    shooting: Shooting, windows: Sequence[WindowMotion], finer: Shooting, same: Sequence[WindowMotion]
) -> float:
    """Mean distance [m] of the frames after the first."""
    distances = [
        np.linalg.norm(b.positions[:: finer.substeps] - a.positions[:: shooting.substeps], axis=-1).mean(-1)[
            1:
        ]
        for a, b in zip(windows, same, strict=True)
    ]
    return float(np.concatenate(distances).mean())
