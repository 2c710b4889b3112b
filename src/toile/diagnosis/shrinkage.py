"""How far the error of held-out frames falls with an effect in the model, beside placebos."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from toile.cloth.state import State
from toile.diagnosis.base_fit import base_of, local_scales
from toile.diagnosis.continuity import Discrepancy
from toile.diagnosis.findings import Finding
from toile.diagnosis.held_out import Prediction, predict
from toile.diagnosis.mechanics import Mechanics
from toile.effects.base import Effect
from toile.evaluation.diagnosis_record import Shrink

Array = NDArray[np.float64]

METRIC = "distance to tracked positions [mm]"

# Logarithm that counts for a window in which the solver fails with an effect and not without.
_FAILED = -1.0

# Neighbouring frames share their error: resampled two at a time.
_BLOCK = 2
_RESAMPLINGS = 400


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
    names: Sequence[str],
    findings: Mapping[str, Finding],
    *,
    used: int,
    horizon: int,
    discrepancy: Discrepancy,
    n_placebos: int,
    seed: int,
) -> HeldOut:
    """Open rollouts over the frames after the fitted ones, with and without effects.

    Stiffness, wind, starts and forces of the fitted frames are refitted with each effect; over the held-out
    ones nothing is free. Effects whose refit or rollout fails are left out.

    Args:
        mechanics: base fit and evidence.
        names: effects that move the cloth.
        findings: their numbers.
        used: frames that were fitted.
        horizon: held-out frames at most.
        discrepancy: in the refit.
        n_placebos: force fields without meaning, see best_placebo.
        seed: of placebos and resampling.
    """
    fit, around = mechanics.fit, mechanics.around
    first = used - 1
    last = min(around.n_frames - 1, first + horizon)
    end = fit.windows[-1].end
    if last <= first or end is None:
        return HeldOut({}, (), {})
    base = predict(mechanics.shooting, around, fit.base, (), end, first, last)
    if base is None:
        return HeldOut({}, (), {})
    positions = {BASE: base.positions}
    placebo, field = best_placebo(mechanics, end, base, first, last, n_placebos, seed)
    if field is not None:
        positions[PLACEBO] = field.positions
    found: dict[str, Shrink] = {}
    for name in names:
        refit = refit_with(mechanics, name, findings[name], discrepancy, last_only=True)
        state = refit.ends[-1]
        if state is None:
            continue
        model = base_of(fit.start_stiffness, refit.values)
        better = predict(
            mechanics.shooting, around, model, (refit.effect,), state, first, last, similar=base.substeps
        )
        if better is None:
            continue
        positions[name] = better.positions
        total = float(1 - better.errors.mean() / base.errors.mean())
        low, high = _interval(base.errors, better.errors, seed)
        found[name] = Shrink(
            METRIC,
            f"frames {first + 1} to {last}",
            float(base.errors.mean() * 1e3),
            float(better.errors.mean() * 1e3),
            total,
            min(low, total),
            max(high, total),
            placebo,
        )
    return HeldOut(found, tuple(range(first + 1, last + 1)), positions)


def best_placebo(
    mechanics: Mechanics, end: State, base: Prediction, first: int, last: int, n: int, seed: int
) -> tuple[float | None, Prediction | None]:
    """Best shrink and its prediction: the last discrepancy carried forward, or the same on other vertices.

    Args:
        mechanics: base fit.
        end: state at ``first``.
        base: prediction of the base model.
        first: frame of the state.
        last: frame.
        n: fields tried; the first is the discrepancy itself.
        seed: of the permutations.
    """
    window = mechanics.fit.windows[-1]
    _, _, force = mechanics.shooting.local(window, window.white)
    rng = np.random.default_rng(seed)
    best: float | None = None
    kept: Prediction | None = None
    for index in range(n):
        field = force[-1] if index == 0 else force[-1][rng.permutation(force.shape[1])]
        found = predict(
            mechanics.shooting,
            mechanics.around,
            mechanics.fit.base,
            (),
            end,
            first,
            last,
            field,
            base.substeps,
        )
        if found is not None:
            shrink = float(1 - found.errors.mean() / base.errors.mean())
            if best is None or shrink > best:
                best, kept = shrink, found
    return best, kept


@dataclass(frozen=True)
class Refit:
    """The model with one effect, refitted to the same frames as the base.

    Attributes:
        effect: with its numbers.
        values: of the base.
        ends: state at the end of every window, None where the solver failed.
    """

    effect: Effect
    values: Array
    ends: list[State | None]


def refit_with(
    mechanics: Mechanics, name: str, finding: Finding, discrepancy: Discrepancy, *, last_only: bool
) -> Refit:
    """Base values, starts, anchors and forces that go best with an effect's numbers, to first order.

    Args:
        mechanics: base fit and evidence.
        name: of the effect.
        finding: its numbers.
        discrepancy: size of the forces [m/s²].
        last_only: simulate the last window alone.
    """
    evidence, fit, shooting = mechanics.evidence, mechanics.fit, mechanics.shooting
    effect = mechanics.effects[name]
    numbers = torch.tensor([finding.mean[p.name] for p in effect.parameters], dtype=torch.float64)
    low = torch.tensor([p.low for p in effect.parameters], dtype=torch.float64)
    high = torch.tensor([p.high for p in effect.parameters], dtype=torch.float64)
    effect = effect.with_values(numbers.clamp(low, high))
    a, b = (evidence.n_base + c for c in mechanics.columns[name])
    white = (effect.values / effect.scales).numpy()
    values, changes = evidence.given(range(a, b), white, discrepancy)
    ends: list[State | None] = []
    for index, window in enumerate(fit.windows):
        if last_only and index < len(fit.windows) - 1:
            ends.append(None)
            continue
        step = changes[index] / local_scales(shooting, window.last - window.first)
        moved = shooting.simulate(
            window, window.white + step, base_of(fit.start_stiffness, values), (effect,), mechanics.around
        )
        ends.append(moved.end if moved.converged else None)
    return Refit(effect, values, ends)


def prediction_gains(
    mechanics: Mechanics, names: Sequence[str], findings: Mapping[str, Finding], discrepancy: Discrepancy
) -> dict[str, float]:
    """Log of how much better a window is foretold from the end of the one before, summed over fitted windows.

    Nothing is free within the window foretold; held-out frames are not looked at. An effect that only takes
    up what the model cannot do otherwise foretells no better.

    Args:
        mechanics: base fit and evidence.
        names: effects that move the cloth.
        findings: their numbers.
        discrepancy: in the refit.
    """
    fit, shooting, around = mechanics.fit, mechanics.shooting, mechanics.around

    def errors(values: Array, effects: tuple[Effect, ...], ends: Sequence[State | None]) -> Array:
        found = np.full(len(fit.windows) - 1, np.nan)
        model = base_of(fit.start_stiffness, values)
        for index, (state, window) in enumerate(zip(ends[:-1], fit.windows[1:], strict=True)):
            if state is not None:
                near = torch.from_numpy(window.positions)[None]
                ahead = predict(
                    shooting, around, model, effects, state, window.first, window.last, similar=near
                )
                found[index] = np.nan if ahead is None else float(ahead.errors.mean())
        return found

    base = errors(fit.values, (), [window.end for window in fit.windows])
    gains = {}
    for name in names:
        refit = refit_with(mechanics, name, findings[name], discrepancy, last_only=False)
        ratio = np.log(base / errors(refit.values, (refit.effect,), refit.ends))
        gains[name] = float(np.nansum(np.where(np.isnan(ratio), _FAILED, ratio)))
    return gains


def _interval(base: Array, better: Array, seed: int) -> tuple[float, float]:
    """90 % interval of the shrink by resampling blocks of frames."""
    rng = np.random.default_rng(seed)
    blocks = np.array_split(np.arange(len(base)), max(1, len(base) // _BLOCK))
    draws = []
    for _ in range(_RESAMPLINGS):
        index = np.concatenate([blocks[i] for i in rng.integers(len(blocks), size=len(blocks))])
        draws.append(1 - better[index].mean() / base[index].mean())
    low, high = np.quantile(draws, (0.05, 0.95))
    return float(low), float(high)
