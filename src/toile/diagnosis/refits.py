"""Every candidate at its own best fit: with the effect in the simulator, and judged around there.

Around the base fit an effect is judged as if all it did were proportional to its strength, and stiffness,
wind, starts and forces answered it in proportion. A frame rate or a stiffness that varies then takes up what
the base model cannot do otherwise, and an anisotropy of a factor of five looks worse than it is. Here the
clip is simulated with each candidate, its numbers and all else are moved to where they suit one another, and
the evidence is that of a Gaussian around that place (Laplace's approximation at the hypothesis' own mode,
MacKay 1992).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from toile.diagnosis.base_fit import base_of, local_scales
from toile.diagnosis.continuity import Discrepancy
from toile.diagnosis.evidence import Evidence, Posterior
from toile.diagnosis.mechanics import Mechanics, effect_systems
from toile.diagnosis.shooting import Base, WindowMotion
from toile.effects.base import Effect
from toile.geometry.camera import Camera

Array = NDArray[np.float64]

# Change of a logarithm of stiffness [1] or of the wind [m/s²] in one pass at most.
_LONGEST = np.array([0.7, 0.7, 0.7, 2.0, 2.0])
# A pass that lowers the cost by less than this is the last one.
_LITTLE = 2.0
# Log evidence by which a pass may change it and be the last one.
_SETTLED = 1.0
# Lengths of a step that are tried, and by which factor they shrink.
_TRIED = 4
_SHORTER = 0.4


@dataclass(frozen=True)
class Refit:
    """A hypothesis at its best fit.

    Attributes:
        effects: in the model with their numbers, one or none. None as well where no step with the effect
            lowered the cost: what it promised to first order is not there.
        base: stiffness and wind.
        windows: simulated.
        evidence: of hypotheses around there.
        log_evidence: means something beside that of another hypothesis on the same clip.
        mean, covariance: of the effect's numbers in prior deviations (n,), (n, n).
    """

    effects: tuple[Effect, ...]
    base: Base
    windows: list[WindowMotion]
    evidence: Evidence
    log_evidence: float
    mean: Array
    covariance: Array


@dataclass(frozen=True)
class _Moved:
    """Windows, base values and numbers of the effect after a pass, and by how much the cost has fallen."""

    windows: list[WindowMotion]
    values: Array
    numbers: Array
    effects: tuple[Effect, ...]
    gained: float


def settled(mechanics: Mechanics, camera: Camera, usual: Discrepancy, passes: int) -> Mechanics:
    """The base model fitted with forces of the size that it needs, and effects to first order around there.

    The base fit leaves much to its forces so as to find the motion from afar. Where far smaller ones do, all
    else has to move a good way, and what effects seem to gain on that way is not theirs.

    Args:
        mechanics: base fit and linear systems around it, without effects.
        camera: nominal.
        usual: discrepancy of a right model.
        passes: at most.
    """
    shooting, fit, evidence = mechanics.shooting, mechanics.fit, mechanics.evidence
    effects = list(mechanics.effects.values())
    n = sum(len(effect.scales) for effect in effects)
    for index in range(passes):
        best = evidence.posterior((), usual)
        moved = _step(mechanics, evidence, best, None, fit.windows, np.zeros(0))
        if moved is None:
            break
        fit = replace(fit, windows=moved.windows, values=moved.values)
        if moved.gained < _LITTLE or index + 1 == passes:
            break
        systems = effect_systems(shooting, fit, (), mechanics.around, None, 0)
        evidence = Evidence(systems, fit.values, evidence.deviations, evidence.slack)
    systems = effect_systems(shooting, fit, effects, mechanics.around, camera, n)
    evidence = Evidence(systems, fit.values, evidence.deviations, evidence.slack)
    return replace(mechanics, fit=fit, evidence=evidence)


def refit(
    mechanics: Mechanics,
    effect: Effect | None,
    columns: Sequence[int],
    usual: Discrepancy,
    passes: int,
    hopeless: float = -np.inf,
) -> Refit:
    """Fit a hypothesis from the base fit on.

    Args:
        mechanics: settled, see there.
        effect: of the catalogue; None for the base model itself.
        columns: numbers of the effect that are free, the others stay zero.
        usual: discrepancy of a right model; the hypothesis has to do with it.
        passes: at most.
        hopeless: log evidence below which there are no more than two of them.
    """
    shooting, fit, first = mechanics.shooting, mechanics.fit, mechanics.evidence
    n_base = first.n_base
    windows, values = fit.windows, fit.values
    n = 0 if effect is None else len(effect.scales)
    numbers = np.zeros(n)
    free = [n_base + c for c in columns]
    a = 0 if effect is None else n_base + mechanics.columns[effect.NAME][0]
    systems = [s.with_shared([*range(n_base), *range(a, a + n)]) for s in first.systems]
    evidence = Evidence(systems, values, first.deviations, first.slack)
    best = evidence.scaled(free, usual)
    acting: tuple[Effect, ...] = ()
    now = best.log_evidence - _image_cost(mechanics, windows)
    for index in range(passes):
        moved = _step(mechanics, evidence, best, effect, windows, numbers)
        if moved is None:
            break
        windows, values, numbers, acting = moved.windows, moved.values, moved.numbers, moved.effects
        systems = effect_systems(
            shooting,
            replace(fit, windows=windows, values=values),
            acting,
            mechanics.around,
            None,
            n,
        )
        evidence = Evidence(systems, values, first.deviations, first.slack, numbers)
        best = evidence.scaled(free, usual)
        before, now = now, best.log_evidence - _image_cost(mechanics, windows)
        # The first pass may lead through places that are worse.
        if index > 0 and (now < hopeless or abs(now - before) < _SETTLED):
            break
    mean, covariance = np.zeros(n), np.zeros((n, n))
    at = [c - n_base for c in best.columns]
    mean[at] = best.mean
    covariance[np.ix_(at, at)] = best.covariance
    return Refit(acting, base_of(fit.start_stiffness, values), windows, evidence, now, mean, covariance)


def _image_cost(mechanics: Mechanics, windows: Sequence[WindowMotion]) -> float:
    return sum(mechanics.shooting.image_cost(window) for window in windows)


def _step(
    mechanics: Mechanics,
    evidence: Evidence,
    best: Posterior,
    effect: Effect | None,
    windows: list[WindowMotion],
    numbers: Array,
) -> _Moved | None:
    """One pass; None where no step lowers the cost."""
    shooting, start = mechanics.shooting, mechanics.fit.start_stiffness
    at = [c - evidence.n_base for c in best.columns]

    def cost(moved: list[WindowMotion], base: Array, own: Array) -> float:
        prior = (base / evidence.deviations) ** 2
        images = shooting.clip_cost(moved, best.discrepancy)
        return images + 0.5 * float(prior.sum() + ((own[at] / best.slack) ** 2).sum())

    before = cost(windows, evidence.values, numbers)
    length = 1.0
    for _ in range(_TRIED):
        values, own, changes, length = evidence.towards(best, length, _LONGEST)
        trial = numbers.copy()
        trial[at] = own
        acting: tuple[Effect, ...] = ()
        if effect is not None:
            low = np.array([p.low / p.scale for p in effect.parameters])
            high = np.array([p.high / p.scale for p in effect.parameters])
            trial = trial.clip(low, high)
            acting = (effect.with_values(torch.from_numpy(trial) * effect.scales),)
        base = base_of(start, values)
        try:
            moved = [
                shooting.simulate(
                    window,
                    window.white + change / local_scales(shooting, window.last - window.first),
                    base,
                    acting,
                    mechanics.around,
                )
                for window, change in zip(windows, changes, strict=True)
            ]
        except FloatingPointError:
            # Effects can be strong enough to blow up a step.
            length *= _SHORTER
            continue
        gained = before - cost(moved, values, trial)
        if gained > 0 and all(window.converged for window in moved):
            return _Moved(moved, values, trial, acting, gained)
        length *= _SHORTER
    return None
