"""Which clip to record next: the one after which the answer is expected to be clearest.

For every motion that somebody may record, the base model of the session simulates a clip of this very cloth;
the information that its images would add on every effect's coefficients is known before it is filmed. A
hypothesis is drawn from the posterior with its coefficients, it draws what the clip would say, Bayes' rule
gives the evidence after it, and that becomes probabilities as the evidence of so many clips does: the
expected fall of their entropy is the information gained (Lindley 1956, On a measure of the information
provided by an experiment). The law is wrong about the clip as it is about the others, so what it draws
scatters by as much as the evidence is too large.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import softmax
from scipy.stats import entropy

from toile.diagnosis.continuity import WindowSystem
from toile.diagnosis.joint_fit import JointFit, JointFitting
from toile.diagnosis.planned_clip import CALM, planned_clip
from toile.diagnosis.session_weights import MotionEvidence, SessionWeights, chances
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


@dataclass(frozen=True)
class _Further(MotionEvidence):
    """Evidence with what a clip may add.

    Attributes:
        more: log evidence by effect [nats].
        share: of that which remains where the forces within the cloth are free, by effect.
    """

    more: Mapping[str, float] = field(default_factory=dict)
    share: Mapping[str, float] = field(default_factory=dict)

    def nats(self, name: str) -> float:
        return super().nats(name) + self.more.get(name, 0.0)

    def freed_nats(self, name: str) -> float:
        return super().freed_nats(name) + self.share[name] * self.more.get(name, 0.0)


def expected_gains(
    fitting: JointFitting,
    base: JointFit,
    fits: Mapping[str, JointFit],
    effects: Sequence[Effect],
    systems: Sequence[Sequence[WindowSystem]],
    evidence: MotionEvidence,
    weights: SessionWeights,
    motions: Iterable[str],
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
        effects: that move the cloth, and stand-ins.
        systems: of every clip around the base model, see JointFitting.systems.
        evidence: what the motion says so far.
        weights: for one clip.
        motions: that may be recorded; those that cannot be simulated are left out, and the log says so.
        draws: of what a clip may say, for every hypothesis.
        seed: of the draws.
        workers: share the windows.
        boundary: see planned_clip.
    """
    before = fitting.fisher(effects, systems) / evidence.scale
    gains = {}
    like = fitting.clips[0]
    n_frames = min(clip.windows[-1].last for clip in fitting.clips) + 1
    n_clips = len(fitting.clips)
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
        after = more.fisher(effects, [*systems, *alone.systems(effects, expected, workers)]) / evidence.scale
        known, kept = _known(fitting, more, fits, effects, evidence.scale)
        after[np.ix_(kept, kept)] -= before
        rng = np.random.default_rng(seed)
        gains[motion] = expected_gain(
            known, after, evidence, weights, n_clips, draws, rng, calm=motion == CALM
        )
    return dict(sorted(gains.items(), key=lambda gain: -gain[1]))


def expected_gain(
    known: Mapping[str, Known],
    information: Array,
    evidence: MotionEvidence,
    weights: SessionWeights,
    n_clips: int,
    draws: int,
    rng: np.random.Generator,
    *,
    calm: bool = False,
) -> float:
    """Expected fall of the entropy of the hypotheses by data that say so much [nats].

    Args:
        known: of every effect, before.
        information: that the data add on all coefficients (n, n).
        evidence: before.
        weights: for one clip.
        n_clips: that the evidence is from.
        draws: for every hypothesis.
        rng: draws.
        calm: whether nothing of what the clip alone has acts in it.
    """
    now, then = weights.of_clips(n_clips), weights.of_clips(n_clips + 1)
    # Of none a part may be an effect that moves the cloth by little: more clips would be as sure of it.
    parts = evidence.parts(now)
    truths: dict[str, float] = {}
    for (_, acting), share in zip(parts, softmax(list(parts.values())), strict=True):
        truths[acting] = truths.get(acting, 0.0) + float(share)
    values, vectors = np.linalg.eigh(0.5 * (information + information.T))
    # Differences of large matrices; what falls below zero is rounding.
    spread = vectors * np.sqrt(np.clip(values, 0.0, None))
    information = spread @ spread.T
    updates = {name: _Update(one, information, calm) for name, one in known.items()}
    of_free = {name: _share(evidence, name) for name in evidence.outside}
    total, left = 0.0, 0.0
    for truth, chance in truths.items():
        if chance < _SMALLEST:
            continue
        for _ in range(draws):
            coefficients = np.zeros(len(information))
            if truth in known:
                one = known[truth]
                coefficients[one.own] = one.mean + one.spread @ rng.standard_normal(len(one.mean))
                if not calm:
                    coefficients[one.new] = one.usual * rng.standard_normal(len(one.new))
            # How wrong the law is about this cloth is as unknown as it is to the odds.
            wrong = then.temperature * np.exp(weights.law_spread * rng.standard_normal())
            noise = np.sqrt(max(1.0, wrong)) * spread @ rng.standard_normal(len(information))
            score = information @ coefficients + noise
            more = {name: updates[name].nats(score) for name in updates}
            further = _Further(**_fields(evidence), more=more, share=of_free)
            left += chance / draws * _entropy(chances(further, then))
        total += chance
    return float(_entropy(chances(evidence, now)) - left / total)


def _fields(evidence: MotionEvidence) -> dict[str, Any]:
    return {one.name: getattr(evidence, one.name) for one in fields(MotionEvidence)}


def _share(evidence: MotionEvidence, name: str) -> float:
    """Of what the clips know of an effect, the share that they know with the forces within the cloth free."""
    if name not in evidence.effects:
        return 1.0
    under_law = sum(evidence.effects[name].information)
    return min(1.0, sum(evidence.outside[name].information) / max(under_law, 1e-12))


class _Update:
    """Bayes' rule for one effect and data that say so much; all but their score is known before they come."""

    def __init__(self, known: Known, information: Array, calm: bool) -> None:
        new = known.new[:0] if calm else known.new
        self._at = np.concatenate((known.own, new)).astype(np.intp)
        n, m = len(known.own), len(new)
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


def _entropy(of: Mapping[str, float]) -> float:
    return float(entropy(list(of.values())))


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
