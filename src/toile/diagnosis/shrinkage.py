"""How far the error of held-out frames falls with an effect in the model, beside placebos."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated

import numpy as np
import torch
from numpy.typing import NDArray

from toile.diagnosis.held_out import Prediction, predict
from toile.diagnosis.mechanics import Mechanics
from toile.diagnosis.record import Shrink
from toile.diagnosis.refits import Refit
from toile.diagnosis.shooting import Base, WindowMotion
from toile.effects.base import Effect
from toile.limits import Count, Finite, Unit
from toile.workers import ALONE, Workers

Array = NDArray[np.float64]

METRIC = "distance to tracked positions [mm]"


@dataclass(frozen=True)
class PredictionSettings:
    """How predictions with and without an effect are compared.

    Attributes:
        failed: logarithm that counts for a window in which the solver fails with an effect and not without.
        block: neighbouring held-out frames that share their error: resampled so many at a time.
        resamplings: for the interval of a held-out shrink.
    """

    failed: Finite = -1.0
    block: Annotated[Count, Unit("frames")] = 2
    resamplings: Count = 400


DEFAULT = PredictionSettings()


@dataclass(frozen=True)
class HeldOut:
    """What was predicted of the frames that no fit has seen.

    Attributes:
        shrinks: by effect.
        frames: that were predicted.
        positions: on the model's grid (n, N, 3) [m], of BASE, PLACEBO (the best one) and the effects.
    """

    shrinks: dict[str, Shrink]
    frames: tuple[int, ...]
    positions: dict[str, Array]


BASE = "base"
PLACEBO = "placebo"


def held_out_shrinks(
    mechanics: Mechanics,
    base: Refit,
    refits: Mapping[str, Refit],
    *,
    used: int,
    known: int,
    horizon: int,
    n_placebos: int,
    seed: int,
    settings: PredictionSettings = DEFAULT,
) -> HeldOut:
    """Open rollouts over the frames after the fitted ones, with and without effects.

    Over the held-out frames nothing is free. Effects whose rollout fails are left out.

    Args:
        mechanics: the problem.
        base: the base model at its best.
        refits: effects that move the cloth, by name.
        used: frames that were fitted.
        known: frames in which the tracked motion is that of the cloth.
        horizon: held-out frames at most.
        n_placebos: force fields without meaning, see best_placebo.
        seed: of placebos and resampling.
        settings: see PredictionSettings.
    """
    around = mechanics.around
    first = used - 1
    last = min(known - 1, first + horizon)
    end = base.windows[-1].end
    if last <= first or end is None:
        return HeldOut({}, (), {})
    without = predict(mechanics.shooting, around, base.base, (), end, first, last)
    if without is None:
        return HeldOut({}, (), {})
    positions = {BASE: without.positions}
    placebo, field = best_placebo(mechanics, base, without, first, last, n_placebos, seed)
    if field is not None:
        positions[PLACEBO] = field.positions
    found: dict[str, Shrink] = {}
    for name, model in refits.items():
        state = model.windows[-1].end
        if state is None:
            continue
        better = predict(
            mechanics.shooting,
            around,
            model.base,
            model.effects,
            state,
            first,
            last,
            similar=without.substeps,
        )
        if better is None:
            continue
        positions[name] = better.positions
        total = shrink_of(without.errors, better.errors)
        low, high = interval(without.errors, better.errors, seed, settings)
        found[name] = Shrink(
            METRIC,
            f"frames {first + 1} to {last}",
            float(without.errors.mean() * 1e3),
            float(better.errors.mean() * 1e3),
            total,
            min(low, total),
            max(high, total),
            placebo,
        )
    return HeldOut(found, tuple(range(first + 1, last + 1)), positions)


def best_placebo(
    mechanics: Mechanics, base: Refit, without: Prediction, first: int, last: int, n: int, seed: int
) -> tuple[float | None, Prediction | None]:
    """Best shrink and its prediction: the last discrepancy carried forward, or the same on other vertices.

    Args:
        mechanics: the problem.
        base: the base model at its best.
        without: its prediction.
        first: frame where it starts.
        last: frame.
        n: fields tried; the first is the discrepancy itself.
        seed: of the permutations.
    """
    window = base.windows[-1]
    assert window.end is not None
    _, _, force = mechanics.shooting.local(window, window.standardised)
    rng = np.random.default_rng(seed)
    best: float | None = None
    kept: Prediction | None = None
    for index in range(n):
        field = force[-1] if index == 0 else force[-1][rng.permutation(force.shape[1])]
        found = predict(
            mechanics.shooting,
            mechanics.around,
            base.base,
            (),
            window.end,
            first,
            last,
            field,
            without.substeps,
        )
        if found is not None:
            shrink = shrink_of(without.errors, found.errors)
            if best is None or shrink > best:
                best, kept = shrink, found
    return best, kept


def prediction_gains(
    mechanics: Mechanics,
    base: Refit,
    refits: Mapping[str, Refit],
    workers: Workers = ALONE,
    settings: PredictionSettings = DEFAULT,
) -> dict[str, float]:
    """Log of how much better windows are predicted from the end of the one before, summed over them.

    Nothing is free within the window predicted; held-out frames are not looked at. An effect that only takes
    up what the model cannot do otherwise predicts no better.

    Args:
        mechanics: the problem.
        base: the base model at its best.
        refits: effects that move the cloth, by name.
        workers: share the models.
        settings: see PredictionSettings.
    """
    shooting, around = mechanics.shooting, mechanics.around

    def errors(model: tuple[Base, tuple[Effect, ...], list[WindowMotion]]) -> Array:
        values, effects, windows = model
        found = np.full(len(windows) - 1, np.nan)
        for index, (before, window) in enumerate(pairwise(windows)):
            if before.end is not None:
                near = torch.from_numpy(window.positions)[None]
                ahead = predict(
                    shooting,
                    around,
                    values,
                    effects,
                    before.end,
                    window.first,
                    window.last,
                    similar=near,
                )
                found[index] = np.nan if ahead is None else float(ahead.errors.mean())
        return found

    models = [(model.base, model.effects, model.windows) for model in (base, *refits.values())]
    without, *others = workers.map(errors, models)
    gains = {}
    for name, found in zip(refits, others, strict=True):
        ratio = np.log(without / found)
        gains[name] = float(np.nansum(np.where(np.isnan(ratio), settings.failed, ratio)))
    return gains


def shrink_of(base: Array, better: Array) -> float:
    """Share by which the mean of errors (n,) falls."""
    return float(1 - better.mean() / base.mean())


def interval(base: Array, better: Array, seed: int, settings: PredictionSettings) -> tuple[float, float]:
    """90 % interval of the shrink by the circular block bootstrap over frames (Politis and Romano, 1992)."""
    from arch.bootstrap import CircularBlockBootstrap  # takes seconds

    frames = CircularBlockBootstrap(settings.block, base, better, seed=np.random.default_rng(seed))
    found = frames.conf_int(
        lambda *errors: np.array([shrink_of(*errors)]), settings.resamplings, method="percentile", size=0.9
    )
    return float(found[0, 0]), float(found[1, 0])
