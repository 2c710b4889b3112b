"""Which clip to record next: the one after which the answer is expected to be clearest.

For every motion that somebody may record, the base model of the session simulates a clip of this very cloth;
the information that its images would add on every effect's coefficients is known before it is filmed. A
hypothesis is drawn from the posterior with its coefficients, it draws what the clip would say, and Bayes'
rule gives the posterior after it: the expected fall of its entropy is the information gained (Lindley 1956,
On a measure of the information provided by an experiment).
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_softmax

from toile.diagnosis.continuity import WindowSystem
from toile.diagnosis.decision import NONE
from toile.diagnosis.joint_fit import JointFit, JointFitting
from toile.diagnosis.planned_clip import planned_clip
from toile.effects.base import Effect, Scope
from toile.physics.simulator import SimulationError
from toile.workers import ALONE, Workers

Array = NDArray[np.float64]
Places = NDArray[np.intp]

_log = logging.getLogger(__name__)

_SMALLEST = 1e-4
"""Probability of hypotheses that are drawn from."""


@dataclass(frozen=True)
class Known:
    """What the clips so far say of one effect: a Gaussian over its coefficients.

    Attributes:
        mean: (n,) in prior deviations.
        covariance: (n, n).
        own: places of these in the coefficients that the next clip tells of (n,).
        new: places of those that the next clip alone has, such as its gusts (m,).
        size: prior deviation of each of the latter.
        usual: root mean square of what they are when the effect acts.
    """

    mean: Array
    covariance: Array
    own: Places
    new: Places
    size: float
    usual: float

    @cached_property
    def precision(self) -> Array:
        """Inverse of the covariance."""
        return np.asarray(np.linalg.inv(self.covariance), np.float64)

    @cached_property
    def spread(self) -> Array:
        """A root of the covariance (n, n)."""
        values, vectors = np.linalg.eigh(self.covariance)
        return np.asarray(vectors * np.sqrt(np.clip(values, 0.0, None)))


def expected_gains(
    fitting: JointFitting,
    base: JointFit,
    fits: Mapping[str, JointFit],
    effects: Sequence[Effect],
    systems: Sequence[Sequence[WindowSystem]],
    chances: Mapping[str, float],
    motions: Iterable[str],
    temperature: float,
    scale: float,
    draws: int,
    seed: int,
    workers: Workers = ALONE,
    *,
    boundary: float,
) -> dict[str, float]:
    """Expected fall of the answer's entropy by one more clip of each motion [nats], largest first.

    Args:
        fitting: the session's problem; the clip is planned after its first clip.
        base: the base model.
        fits: of every effect.
        effects: that move the cloth.
        systems: of every clip around the base model, see JointFitting.systems.
        chances: probabilities of all hypotheses.
        motions: that may be recorded; those that cannot be simulated are left out, and the log says so.
        temperature: evidence by which odds grow e-fold [nats].
        scale: by which misfits are too large.
        draws: of what a clip may say, for every hypothesis.
        seed: of the draws.
        workers: share the windows.
        boundary: see planned_clip.
    """
    before = fitting.fisher(effects, systems) / scale
    gains = {}
    like = fitting.clips[0]
    n_frames = min(clip.windows[-1].last for clip in fitting.clips) + 1
    for motion in motions:
        try:
            n = len(fitting.start)
            clip, wind = planned_clip(
                like, motion, fitting.start * np.exp(base.values[:n]), n_frames, boundary
            )
        except SimulationError as error:
            _log.warning("No clip of the kind %r could be planned: %s", motion, error)
            continue
        more = JointFitting([*fitting.clips, clip], fitting.start, base.values[:n], fitting.settings)
        alone = JointFitting([clip], fitting.start, base.values[:n], fitting.settings)
        expected = alone.expected(np.concatenate((base.values[:n], wind)))
        after = more.fisher(effects, [*systems, *alone.systems(effects, expected, workers)]) / scale
        known, kept = _known(fitting, more, fits, effects, scale)
        after[np.ix_(kept, kept)] -= before
        rng = np.random.default_rng(seed)
        gains[motion] = expected_gain(
            known, after, chances, temperature, draws, rng, still_air=clip.still_air
        )
    return dict(sorted(gains.items(), key=lambda gain: -gain[1]))


def expected_gain(
    known: Mapping[str, Known],
    information: Array,
    chances: Mapping[str, float],
    temperature: float,
    draws: int,
    rng: np.random.Generator,
    *,
    still_air: bool = False,
) -> float:
    """Expected fall of the entropy of the hypotheses by data that say so much [nats].

    Args:
        known: of every effect, before.
        information: that the data add on all coefficients (n, n).
        chances: probabilities before; hypotheses without coefficients stay as probable as they are.
        temperature: see expected_gains.
        draws: for every hypothesis.
        rng: draws.
        still_air: whether nothing of what the clip alone has acts in it.
    """
    names = list(chances)
    logits = np.log(np.maximum([chances[name] for name in names], 1e-12))
    values, vectors = np.linalg.eigh(0.5 * (information + information.T))
    # Differences of large matrices; what falls below zero is rounding.
    spread = vectors * np.sqrt(np.clip(values, 0.0, None))
    information = spread @ spread.T
    updates = {name: _Update(one, information) for name, one in known.items()}
    total, entropy = 0.0, 0.0
    for truth in names:
        if chances[truth] < _SMALLEST or (truth != NONE and truth not in known):
            continue
        for _ in range(draws):
            coefficients = np.zeros(len(information))
            if truth in known:
                one = known[truth]
                coefficients[one.own] = one.mean + one.spread @ rng.standard_normal(len(one.mean))
                here = 0.0 if still_air else one.usual
                coefficients[one.new] = here * rng.standard_normal(len(one.new))
            score = information @ coefficients + spread @ rng.standard_normal(len(information))
            added = [updates[name].nats(score) / temperature if name in known else 0.0 for name in names]
            entropy += chances[truth] / draws * _entropy(logits + added)
        total += chances[truth]
    return float(_entropy(logits) - entropy / total) if total else 0.0


class _Update:
    """Bayes' rule for one effect and data that say so much; all but their score is known before they come."""

    def __init__(self, known: Known, information: Array) -> None:
        self._at = np.concatenate((known.own, known.new)).astype(np.intp)
        n, m = len(known.own), len(known.new)
        before = np.zeros((n + m, n + m))
        before[:n, :n] = known.precision
        before[n:, n:] = np.eye(m) / known.size**2
        after = before + information[np.ix_(self._at, self._at)]
        self._covariance = np.linalg.inv(after)
        self._right = before[:, :n] @ known.mean
        wider, narrower = np.linalg.slogdet(before)[1], np.linalg.slogdet(after)[1]
        self._constant = float(wider - narrower - known.mean @ known.precision @ known.mean)

    def nats(self, score: Array) -> float:
        """Log evidence of the effect against none, from data of this score."""
        right = self._right + score[self._at]
        return 0.5 * float(right @ self._covariance @ right + self._constant)


def _entropy(logits: Array) -> float:
    logs = log_softmax(logits)
    return float(-(np.exp(logs) * logs).sum())


def _known(
    fitting: JointFitting,
    more: JointFitting,
    fits: Mapping[str, JointFit],
    effects: Sequence[Effect],
    scale: float,
) -> tuple[dict[str, Known], Places]:
    """What is known of every effect, and where coefficients of so far are among those with one clip more."""
    layout, longer = fitting.layout(effects), more.layout(effects)
    kept = np.zeros(layout.n_coefficients, np.intp)
    for clip in range(layout.n_clips):
        for old, new in zip(layout.coefficients(clip), longer.coefficients(clip), strict=True):
            kept[old] = new
    known = {}
    for effect, before, after in zip(effects, layout.places, longer.places, strict=True):
        fit, own = fits[effect.NAME], kept[before]
        covariance = 0.5 * scale * (fit.own_covariance + fit.own_covariance.T) + 1e-9 * np.eye(len(own))
        usual = float(np.sqrt((fit.own**2).mean())) if effect.SCOPE is Scope.CLIP else 0.0
        beyond = np.array(sorted(set(after) - set(own.tolist())), np.intp)
        known[effect.NAME] = Known(fit.own, covariance, own, beyond, fit.size, usual)
    return known, kept
