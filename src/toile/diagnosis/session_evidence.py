"""What the clips of a session say together about every hypothesis."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import softmax

from toile.diagnosis.decision import NONE, UNKNOWN, Calibration
from toile.diagnosis.findings import Finding, finding
from toile.diagnosis.joint_fit import JointFit
from toile.effects.base import Effect, Scope

Array = NDArray[np.float64]

_LEAST = 1e-4
"""Probability of the learned decision that says no more, and share of the usual misfit that does."""


@dataclass(frozen=True)
class SessionWeights:
    """How evidence of the motion becomes a probability.

    Attributes:
        usual: misfit that a right model leaves, per frame at 25 frames a second [nats].
        threshold: evidence at which an effect and none are equally probable [nats].
        temperature: evidence by which the odds of an effect grow e-fold [nats].
        strange: how many times the usual misfit the best hypothesis leaves where something unknown and none
            are equally probable.
        strangeness: e-folds of the odds of something unknown for each logarithm beyond that.
        learned: weight of the learned decision's log odds among effects.
    """

    usual: float = 3.0
    threshold: float = 12.0
    temperature: float = 5.0
    strange: float = 4.0
    strangeness: float = 4.0
    learned: float = 1.0


DEFAULT = SessionWeights()


@dataclass(frozen=True)
class SessionEvidence:
    """What speaks for every hypothesis.

    Attributes:
        findings: of every candidate; log evidence in nats against the base model.
        drops: of the misfit, without any penalty, of effects that move the cloth.
        chances: probabilities, NONE and UNKNOWN among them, most probable first.
        left: misfit of the best hypothesis over the usual one.
    """

    findings: dict[str, Finding]
    drops: dict[str, float]
    chances: dict[str, float]
    left: float


def session_evidence(
    base: JointFit,
    fits: Mapping[str, JointFit],
    effects: Sequence[Effect],
    of_images: Sequence[Mapping[str, Finding]],
    duration: float,
    calibration: Calibration,
    learned: Mapping[str, float] | None,
    weights: SessionWeights = DEFAULT,
) -> SessionEvidence:
    """Put together what motion and images of all clips say.

    Args:
        base: the base model.
        fits: of effects that move the cloth, by name.
        effects: all candidates.
        of_images: findings of every clip without a model of the motion, by name.
        duration: of all clips [s].
        calibration: of the images' findings.
        learned: probabilities of the learned decision by label, None where there is none.
        weights: see SessionWeights.
    """
    by_name = {effect.NAME: effect for effect in effects}
    usual = weights.usual * duration * 25
    # Below zero where the tracked motion, at which the image term is zero, is not its minimum.
    best = max(min([base.misfit, *(fit.misfit for fit in fits.values())]), _LEAST * usual)
    # What even the best hypothesis is wrong by is no noise of the size that was thought.
    scale = max(1.0, best / usual)
    findings = {
        name: _of_images(by_name[name], name, of_images) for name in (of_images[0] if of_images else {})
    }
    drops, logits = {}, {NONE: 0.0}
    for name, fit in fits.items():
        drops[name] = base.misfit - fit.misfit
        n = len(by_name[name].scales)
        nats = drops[name] / scale - fit.occam
        findings[name] = finding(by_name[name], nats, fit.coefficients[:n], scale * fit.covariance[:n, :n])
    for name, found in findings.items():
        if name in fits:
            logits[name] = (found.log_evidence - weights.threshold) / weights.temperature
            logits[name] += weights.learned * _log_odds(learned, name, fits)
        else:
            score = calibration.score(name, found.log_evidence)
            logits[name] = (score - calibration.threshold) / calibration.temperature
    strange = weights.strangeness * np.log(best / (weights.strange * usual))
    logits[UNKNOWN] = float(strange)
    return SessionEvidence(findings, drops, _chances(logits), best / usual)


def _log_odds(learned: Mapping[str, float] | None, name: str, effects: Collection[str]) -> float:
    """Of an effect against the mean of those in question; 0 for what the learned decision does not know.

    None and what is outside the catalogue are left to the physical evidence: where they end does not carry
    over from engine to engine, which effect it is does (docs/results/learned_decision.md).
    """
    known = [learned[other] for other in effects if other in learned] if learned else []
    if not learned or name not in learned or not known:
        return 0.0
    return float(np.log(max(learned[name], _LEAST) / max(float(np.mean(known)), _LEAST)))


def _of_images(effect: Effect, name: str, clips: Sequence[Mapping[str, Finding]]) -> Finding:
    """What the images of all clips say; of an effect that belongs to a clip, the clip that says most."""
    found = [clip[name] for clip in clips if name in clip]
    best = max(found, key=lambda one: one.log_evidence)
    if effect.SCOPE is Scope.CLIP or len(found) == 1:
        return best
    mean, deviation = {}, {}
    for parameter in best.mean:
        precision = np.array([max(one.deviation[parameter], 1e-9) ** -2 for one in found])
        values = np.array([one.mean[parameter] for one in found])
        mean[parameter] = float((precision * values).sum() / precision.sum())
        deviation[parameter] = float(precision.sum() ** -0.5)
    return Finding(sum(one.log_evidence for one in found), mean, deviation)


def _chances(logits: Mapping[str, float]) -> dict[str, float]:
    names = list(logits)
    values = softmax(np.array([logits[name] for name in names]))
    order = np.argsort(-values, kind="stable")
    return {names[i]: float(values[i]) for i in order}
