"""Before and after a further training: which weights are chosen, and what they do on held-out cloths."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd
import torch

from surrogate.accuracy import MOTION
from surrogate.cases import Case, box_case, fits_case, make_cases
from surrogate.contenders import Build, surrogate_label
from surrogate.gradients import gradients
from surrogate.reference import reference
from surrogate.stability import REST, WINDOW, StabilitySettings, stability
from toile.physics.cloth import Cloth
from toile.physics.implicit.integrators import Integrator
from toile.physics.linearizable import LinearizableSimulator
from toile.physics.rollout import rollout
from toile.physics.surrogate.simulator import SurrogateSimulator

# Neither training nor any other table draws from these.
VALIDATION_SEEDS = {"fits": 76_000_000, "box": 77_000_000}
BEFORE, AFTER = "before", "after"
MISSING = 1e3  # error of a motion that is not finite [% of width], so that it has a logarithm
_SMALLEST = 1e-4


@dataclass(frozen=True)
class Extent:
    """How much is measured.

    Attributes:
        grid: (H, W) of everything but stability.
        steps: of the motions.
        validation: cloths by regime, on which the weights are chosen.
        held_out: cloths by regime, the first of the model card's.
        passes: of the network.
        stability: see there.
        gradient_seeds: of the gradients.
        gradient_steps: through which they go.
    """

    grid: tuple[int, int] = (32, 32)
    steps: int = 50
    validation: tuple[tuple[str, int], ...] = (("fits", 4), ("box", 6))
    held_out: tuple[tuple[str, int], ...] = (("fits", 8), ("box", 14))
    passes: tuple[int, ...] = (2,)
    stability: StabilitySettings = field(default_factory=StabilitySettings)
    gradient_seeds: int = 3
    gradient_steps: int = 12


def with_weights(weights: Path, passes: int) -> Build:
    """The surrogate with these weights."""

    def build(cloth: Cloth, h: float, integrator: Integrator) -> LinearizableSimulator:
        return SurrogateSimulator(cloth, h, integrator, passes, weights=weights)

    return build


def choice(candidates: dict[str, Path], extent: Extent, cache: Path) -> pd.DataFrame:
    """Errors of all candidates on the validation cloths: one row per candidate and cloth."""
    makers = {"fits": fits_case, "box": box_case}
    cases = [
        makers[regime](VALIDATION_SEEDS[regime] + k, extent.grid, extent.steps)
        for regime, count in extent.validation
        for k in range(count)
    ]
    return _errors({name: with_weights(path, 2) for name, path in candidates.items()}, cases, cache)


def score(errors: pd.DataFrame) -> pd.Series:
    """Mean logarithm of the error of every candidate: a factor counts alike wherever it is gained."""
    logs = errors.assign(log=np.log10(errors[MOTION].clip(_SMALLEST, MISSING)))
    return logs.groupby("contender").log.mean()


def held_out(weights: dict[str, Path], extent: Extent, cache: Path) -> pd.DataFrame:
    """Errors on cloths of the model card: one row per weights, passes and cloth."""
    cases = [
        case
        for regime, count in extent.held_out
        for case in make_cases(regime, count, extent.grid, extent.steps)
    ]
    builds = {
        f"{name}, {surrogate_label(n)}": with_weights(path, n)
        for name, path in weights.items()
        for n in extent.passes
    }
    return _errors(builds, cases, cache)


def motions_to_rest(weights: Path, extent: Extent, before: pd.DataFrame | None) -> pd.DataFrame:
    """Long motions, one pass a step, of the materials that did not come to rest before; see ``stability``.

    Args:
        weights: after the training.
        extent: how long.
        before: motions of all materials with the weights before; None to move all.
    """
    trembling = None
    if before is not None:
        speeds = at_rest(before)
        trembling = [tuple(row) for row in speeds.loc[~speeds.rest, ["Y", "S", "B"]].to_numpy().tolist()]
    return stability({AFTER: with_weights(weights, 1)}, extent.stability, trembling)


def at_rest(table: pd.DataFrame) -> pd.DataFrame:
    """Speed of every material at the end of its motion, and whether that is rest."""
    last = table[table.step > table.step.max() - WINDOW]
    speeds = last.groupby(["Y", "S", "B"], sort=False).speed.max().reset_index()
    return speeds.assign(rest=speeds.speed < REST)


def directions(weights: dict[str, Path], extent: Extent) -> pd.DataFrame:
    """Cosines of gradients with those of the solver, see ``gradients``."""
    builds = {
        f"{name}, {surrogate_label(n)}": with_weights(path, n)
        for name, path in weights.items()
        for n in extent.passes
    }
    return gradients(builds, extent.gradient_seeds, extent.grid, extent.gradient_steps)


@torch.no_grad()
def _errors(builds: dict[str, Build], cases: Sequence[Case], cache: Path) -> pd.DataFrame:
    rows: list[dict[str, object]] = []
    for number, case in enumerate(cases, 1):
        truth = reference(case, cache).positions
        print(f"  {case.regime} {number}/{len(cases)}", flush=True)
        if truth is None:
            continue
        for name, build in builds.items():
            simulator = build(case.cloth, case.time_step, case.integrator)
            start = case.start(simulator.n_past)
            motion = rollout(simulator, start, case.material, case.forces, case.boundary, 1, throw=False)
            away = (motion.positions[0] - truth).norm(dim=-1).mean(-1)[1:]
            error = 100 * float(away.mean()) / case.width
            about = {"regime": case.regime, "seed": case.seed, **case.numbers}
            rows.append({**about, "contender": name, MOTION: error if np.isfinite(error) else MISSING})
    return pd.DataFrame(rows)
