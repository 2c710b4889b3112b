"""Time of a step, alone and in batches, beside the converged solver in the same run.

Processor time of this process: with one thread it is the time on the clock of an idle machine, and what else
runs on the machine changes it little.
"""

from __future__ import annotations

import time

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from surrogate.cases import FIRST_SEED, Case, fits_case
from surrogate.contenders import SOLVER, Build, solver
from surrogate.saddles import Saddles
from toile.physics.cloth import GRID_PARAMETERS
from toile.physics.linearizable import LinearizableSimulator
from toile.physics.material import Material
from toile.physics.state import State

WARM_UP = 20  # steps by the solver from rest to the state where the clock starts
STEPS = 5  # under the clock, one after the other
_FIRST_SEED = FIRST_SEED["fits"] + 600_000


@torch.no_grad()
def speed(contenders: dict[str, Build], size: int, grid: tuple[int, int], repeats: int) -> pd.DataFrame:
    """Of a batch: one row per contender and whether the steps leave their derivatives behind."""
    # One cloth, as a simulator has; poses, materials and forces differ.
    cases = [fits_case(_FIRST_SEED + b, grid, WARM_UP + STEPS, _FIRST_SEED) for b in range(size)]
    first = cases[0]
    exact = solver(first.cloth, first.time_step, first.integrator)
    batch = Batch(cases)
    state = batch.start(exact.n_past)
    for t in range(WARM_UP):
        state = batch.step(exact, state, t)
    rows: list[dict[str, object]] = []
    for linearize in (False, True):
        simulators = {
            name: build(first.cloth, first.time_step, first.integrator)
            for name, build in {SOLVER: solver, **contenders}.items()
        }
        times: dict[str, list[float]] = {name: [] for name in simulators}
        # In turn, so that whatever slows the machine slows all of them alike; the first round warms up.
        for turn in range(repeats + 1):
            for name, simulator in simulators.items():
                started = time.process_time()
                with Saddles():
                    _run(simulator, batch, state, linearize)
                if turn:
                    times[name].append(1e3 * (time.process_time() - started) / STEPS)
        reference = float(np.median(times[SOLVER]))
        for name, measured in times.items():
            low, median, high = np.percentile(measured, [25, 50, 75])
            rows.append(
                {
                    "batch": size,
                    "linearize": linearize,
                    "contender": name,
                    "ms per step": median,
                    "spread [ms]": (high - low) / 2,
                    "solver / this": reference / median,
                }
            )
        print(f"  batch of {size}, linearize={linearize} done", flush=True)
    return pd.DataFrame(rows)


class Batch:
    """Several cases of one cloth."""

    def __init__(self, cases: list[Case]) -> None:
        self.cases = cases
        self.forces = torch.cat([c.forces for c in cases])
        self.boundary = torch.cat([c.boundary for c in cases])
        self.material = Material(GRID_PARAMETERS, torch.cat([c.material.values for c in cases]))

    def start(self, n_past: int) -> State:
        """All at rest."""
        positions: Tensor = torch.cat([c.positions for c in self.cases])
        return State.start(positions, torch.zeros_like(positions), self.cases[0].time_step, n_past)

    def step(self, simulator: LinearizableSimulator, state: State, t: int, keep: bool = False) -> State:
        """Step number t."""
        return simulator.step(
            state, self.material, self.forces[:, t], self.boundary[:, t + 1], linearize=keep
        ).state


def _run(simulator: LinearizableSimulator, batch: Batch, state: State, keep: bool) -> None:
    for t in range(WARM_UP, WARM_UP + STEPS):
        state = batch.step(simulator, state, t, keep)
