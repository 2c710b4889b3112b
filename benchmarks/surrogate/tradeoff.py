"""Error over time: the surrogate by its passes beside Newton's method by its iterations.

Cloths of the *fits* regime that share one shape; poses, materials and forces differ. Time is processor time
of this process on one thread, per cloth and step, without derivatives. Errors are those of a batch of six.
"""

from __future__ import annotations

import copy
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor, nn

from surrogate.cases import FIRST_SEED, fits_case
from surrogate.contenders import SOLVER, Build, line_sweeps, solver
from surrogate.speed import WARM_UP, Batch
from toile.physics.cloth import Cloth
from toile.physics.hybrid.simulator import HybridSimulator
from toile.physics.implicit.integrators import Integrator
from toile.physics.linearizable import LinearizableSimulator
from toile.physics.state import State
from toile.physics.surrogate.problem import StepProblem
from toile.physics.surrogate.simulator import SurrogateSimulator
from toile.physics.surrogate.weights import load_weights

SURROGATE = "network"
LOW = "network, bfloat16"
COMPILED = "network, compiled"
HYBRID = "network, 1 pass, then Newton"
SWEEPS = "no network, line sweeps"
NEWTON = "Newton, stopped"
WITH_NETWORK = (SURROGATE, LOW, COMPILED, HYBRID)
MOTIONS = (10, 50)
"""Steps from rest after which the vertex error is taken."""
STRIDE = 10
"""The error of one step is measured from every so many states of the solver's motion."""
ERRORS = ("error of one step [% of width]", *(f"error after {n} steps [% of width]" for n in MOTIONS))
TIME = "ms per cloth and step"
COMPILING = "compiling [s]"
_MEASURED = 6  # cloths whose errors are measured
_FIRST_SEED = FIRST_SEED["fits"] + 700_000


@dataclass(frozen=True)
class Contender:
    """A way to make steps, with its knob turned to one place.

    Attributes:
        family: see the names above.
        knob: passes, sweeps or Newton iterations; 0 for the solver, which goes on until it has converged.
        build: of its simulator.
    """

    family: str
    knob: int
    build: Build


@dataclass(frozen=True)
class TradeoffSettings:
    """How much is measured.

    Attributes:
        sizes: vertices along a side.
        batches: cloths at once.
        passes: of the network.
        sweeps: of the lines, without the network.
        iterations: of Newton's method.
        rounds: of the time, after one to warm up.
        steps: under the clock in each round.
    """

    sizes: tuple[int, ...] = (16, 32)
    batches: tuple[int, ...] = (1, 8, 32)
    passes: tuple[int, ...] = (1, 2, 4, 8)
    sweeps: tuple[int, ...] = (4, 8, 16, 24)
    iterations: tuple[int, ...] = (1, 2, 3, 4)
    rounds: int = 3
    steps: int = 2


def contenders(weights: Path, settings: TradeoffSettings) -> list[Contender]:
    """All of them, the converged solver first."""
    own = load_weights(weights).network

    def surrogate(passes: int, change: Callable[..., nn.Module] | None) -> Build:
        def build(cloth: Cloth, h: float, integrator: Integrator) -> LinearizableSimulator:
            simulator = SurrogateSimulator(cloth, h, integrator, passes, weights=weights)
            if change is not None:
                simulator.surrogate.network = change()  # type: ignore[assignment]
            return simulator

        return build

    def newton(iterations: int) -> Build:
        return lambda cloth, h, integrator: HybridSimulator(cloth, h, integrator, None, iterations)

    def hybrid(iterations: int) -> Build:
        def build(cloth: Cloth, h: float, integrator: Integrator) -> LinearizableSimulator:
            def predictor(its_cloth: Cloth, step: float) -> LinearizableSimulator:
                return SurrogateSimulator(its_cloth, step, integrator, 1, weights=weights)

            return HybridSimulator(cloth, h, integrator, predictor, iterations)

        return build

    found = [Contender(SOLVER, 0, solver)]
    found += [Contender(SURROGATE, n, surrogate(n, None)) for n in settings.passes]
    # Compiled once: the weights are the same whatever the number of passes.
    for family, change in ((LOW, _LowPrecision), (COMPILED, cache(_compiled))):
        found += [Contender(family, n, surrogate(n, partial(change, own))) for n in settings.passes[:3]]
    found += [Contender(HYBRID, n, hybrid(n)) for n in settings.iterations[:2]]
    found += [Contender(SWEEPS, n, line_sweeps(n)) for n in settings.sweeps]
    return found + [Contender(NEWTON, n, newton(n)) for n in settings.iterations]


@torch.no_grad()
def tradeoff(weights: Path, size: int, batch: int, settings: TradeoffSettings) -> pd.DataFrame:
    """Time of one size and batch: one row per contender."""
    cloths = _cloths(size, batch)
    first = cloths.cases[0]
    exact = solver(first.cloth, first.time_step, first.integrator)
    state = cloths.start(exact.n_past)
    for t in range(WARM_UP):
        state = cloths.step(exact, state, t)
    chosen = contenders(weights, settings)
    simulators = [c.build(first.cloth, first.time_step, first.integrator) for c in chosen]
    times: list[list[float]] = [[] for _ in chosen]
    warming: list[float] = []
    # In turn, so that whatever slows the machine slows all of them alike; the first round warms up.
    for turn in range(settings.rounds + 1):
        for place, simulator in enumerate(simulators):
            started, whole, moved = time.process_time(), _with_compilers(), state
            for t in range(WARM_UP, WARM_UP + (settings.steps if turn else 1)):
                moved = cloths.step(simulator, moved, t)
            taken = time.process_time() - started
            if turn:
                times[place].append(1e3 * taken / settings.steps / batch)
            else:
                warming.append(_with_compilers() - whole)
    rows = []
    for contender, measured, warm in zip(chosen, times, warming, strict=True):
        low, median, high = np.percentile(measured, [25, 50, 75])
        row = {"size": size, "batch": batch, "family": contender.family, "knob": contender.knob}
        # The same blocks serve any number of passes.
        first_use = contender.family == COMPILED and contender.knob == settings.passes[0]
        compiling = warm if first_use else 0.0
        rows.append({**row, TIME: median, "spread [ms]": (high - low) / 2, COMPILING: compiling})
    print(f"  {size}x{size}, batch of {batch}: times done", flush=True)
    return pd.DataFrame(rows)


@torch.no_grad()
def errors(weights: Path, size: int, settings: TradeoffSettings) -> pd.DataFrame:
    """Vertex errors of one size: one row per contender, median of the cloths.

    Compiled blocks are left out: they give what the others give, to rounding.
    """
    cloths = _cloths(size, _MEASURED)
    first = cloths.cases[0]
    width = cloths.cases[0].width
    exact = solver(first.cloth, first.time_step, first.integrator)
    states = [cloths.start(exact.n_past)]
    for t in range(max(MOTIONS)):
        states.append(cloths.step(exact, states[-1], t))
    rows = []
    for contender in contenders(weights, settings):
        row: dict[str, object] = {"size": size, "family": contender.family, "knob": contender.knob}
        if contender.family == COMPILED:
            continue
        if contender.family == SOLVER:
            rows.append({**row, **dict.fromkeys(ERRORS, 0.0)})
            continue
        simulator = contender.build(first.cloth, first.time_step, first.integrator)

        def away(state: State, n: int) -> float:
            return 100 * float((state.positions - states[n].positions).norm(dim=-1).mean(-1).median()) / width

        single = [
            away(cloths.step(simulator, states[t], t), t + 1) for t in range(STRIDE, max(MOTIONS), STRIDE)
        ]
        row[ERRORS[0]] = float(np.mean(single))
        state = states[0]
        for t in range(max(MOTIONS)):
            state = cloths.step(simulator, state, t)
            if t + 1 in MOTIONS:
                row[ERRORS[1 + MOTIONS.index(t + 1)]] = away(state, t + 1)
        rows.append(row)
    print(f"  {size}x{size}: errors done", flush=True)
    return pd.DataFrame(rows)


def _with_compilers() -> float:
    """Processor time of this process and of those that it has waited for [s]."""
    return sum(os.times()[:4])


def _cloths(size: int, batch: int) -> Batch:
    seeds = range(_FIRST_SEED, _FIRST_SEED + batch)
    return Batch([fits_case(seed, (size, size), max(MOTIONS), _FIRST_SEED) for seed in seeds])


class _LowPrecision(nn.Module):
    """The network with convolutions in bfloat16."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, problem: StepProblem, positions: Tensor, residual: Tensor) -> Tensor:
        with torch.autocast("cpu", torch.bfloat16):
            displacement: Tensor = self.network(problem, positions, residual)
        return displacement.float()


def _compiled(network: Any) -> nn.Module:
    """The network with its residual blocks compiled, where its convolutions are.

    The whole would be cut into pieces at every kernel that is not torch's, and compiled for minutes.
    """
    torch._dynamo.reset()
    found = copy.deepcopy(network)
    found.encoders = nn.ModuleList(torch.compile(block) for block in found.encoders)
    found.decoders = nn.ModuleList(torch.compile(block) for block in found.decoders)
    return found  # type: ignore[no-any-return]
