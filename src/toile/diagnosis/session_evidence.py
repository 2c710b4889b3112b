"""What the clips of a session say together about every hypothesis."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import softmax

from toile.diagnosis.decision import NONE, UNKNOWN, Calibration
from toile.diagnosis.findings import Finding, finding
from toile.diagnosis.joint_fit import JointFit
from toile.diagnosis.model_errors import ModelErrors
from toile.diagnosis.outside_causes import OutsideCause
from toile.diagnosis.session_weights import MotionEvidence, SessionWeights
from toile.effects.anchor_slip import AnchorSlip
from toile.effects.base import Effect, Scope
from toile.effects.catalogue import PUSHING, STAND_INS

Array = NDArray[np.float64]

_NEAR = 30.0
"""Evidence in the linearised model by which a stand-in may be behind and is fitted all the same [nats]."""

_WORTH = 1.0
"""Evidence in the linearised model from which on an effect is fitted [nats]: fits of less gain no more."""


@dataclass(frozen=True)
class SessionEvidence:
    """What speaks for every hypothesis.

    Attributes:
        findings: of every candidate; log evidence in nats against the base model.
        drops: of the misfit, without any penalty, of effects that move the cloth.
        logits: log odds of all hypotheses, NONE and UNKNOWN among them, up to a common constant.
        chances: probabilities of them, most probable first.
        left: errors of the best hypothesis over the usual ones, squared.
        scale: by which misfits are too large for the noise that was found.
        motion: what the motion says before any weight.
        of_images: log odds, against none, of effects that images show.
        silent: effects that say nothing, see ``without``.
    """

    findings: dict[str, Finding]
    drops: dict[str, float]
    logits: dict[str, float]
    chances: dict[str, float]
    left: float
    scale: float
    motion: MotionEvidence
    of_images: dict[str, float]
    silent: tuple[str, ...] = ()

    def without(self, names: Collection[str], weights: SessionWeights) -> SessionEvidence:
        """The same without what some effects say, which have no probability then.

        Nor does what they say speak for none, which else has what an effect explains under the law and the
        balance of torques does not know of, see MotionEvidence.odds.

        Args:
            names: of effects that move the cloth.
            weights: see SessionWeights.
        """
        motion = self.motion.without(names)
        logits = _logits(motion, self.of_images, weights)
        chances = {**_chances(logits), **dict.fromkeys(names, 0.0)}
        return replace(self, logits=logits, chances=chances, left=motion.over_usual, silent=tuple(names))


def session_evidence(
    base: JointFit,
    fits: Mapping[str, JointFit],
    effects: Sequence[Effect],
    of_images: Sequence[Mapping[str, Finding]],
    devices: Sequence[int],
    errors: ModelErrors,
    calibration: Calibration,
    learned: Mapping[str, float] | None,
    weights: SessionWeights,
    usual: Mapping[str, float] | None = None,
    plain: JointFit | None = None,
    sizes: Mapping[str, float] | None = None,
    outside: Mapping[str, OutsideCause] | None = None,
    resized: float | None = None,
    covered: float | None = None,
) -> SessionEvidence:
    """Put together what motion and images of all clips say.

    Args:
        base: the base model.
        fits: of effects that move the cloth and of stand-ins, by name; of its own ones the base model's
            itself.
        effects: all candidates.
        of_images: findings of every clip from its images and the paths of its holders, by name.
        devices: that filmed the clips.
        errors: of the base model.
        calibration: of the images' findings.
        learned: probabilities of the learned decision by label, None where there is none.
        weights: see SessionWeights.
        usual: effects that every cloth has, with how far they move this one, see MotionEvidence.
        plain: the base model without its own effects; None where it has none.
        sizes: how far every other effect moves the cloth, see MotionEvidence.
        outside: what speaks for causes from outside, whatever the law is.
        resized: share by which the sides seem to change, see MotionEvidence.
        covered: share of the cloth's print that is hidden, see MotionEvidence.
    """
    outside = outside or {}
    by_name = {effect.NAME: effect for effect in effects}
    motion = replace(
        _of_motion(base, fits, errors, learned, usual or {}, plain),
        sizes={**{name: cause.displacement.last for name, cause in outside.items()}, **(sizes or {})},
        outside={name: cause.evidence for name, cause in outside.items()},
        resized=resized,
        covered=covered,
    )
    drops = {name: one.drop for name, one in motion.effects.items() if name not in STAND_INS}
    left = motion.over_usual
    scale = motion.scale
    findings = {
        name: _of_images(by_name[name], name, of_images, devices)
        for name in (of_images[0] if of_images else {})
    }
    shown: dict[str, float] = {}
    for name, found in findings.items():
        if name == AnchorSlip.NAME:
            # By refined paths, for which single clips have taught nothing.
            shown[name] = (found.log_evidence - weights.slip_threshold) / weights.slip_temperature
        elif name not in fits:
            score = calibration.score(name, found.log_evidence)
            shown[name] = (score - calibration.threshold) / calibration.temperature
    for name, fit in fits.items():
        if name in STAND_INS:
            continue
        n = len(by_name[name].scales)
        covariance = scale * fit.own_covariance[:n, :n]
        findings[name] = finding(by_name[name], motion.nats(name), fit.own[:n], covariance)
        if name in outside and name not in PUSHING:
            cause = outside[name]
            mean = cause.coefficients[:n]
            # All coefficients are too large or too small together.
            together = weights.outside_spread**2 * np.outer(mean, mean)
            covariance = cause.covariance[:n, :n] + together
            findings[name] = finding(by_name[name], cause.evidence.nats(), mean, covariance)
    logits = _logits(motion, shown, weights)
    return SessionEvidence(findings, drops, logits, _chances(logits), left, scale, motion, shown)


def _logits(
    motion: MotionEvidence, of_images: Mapping[str, float], weights: SessionWeights
) -> dict[str, float]:
    """Log odds of all hypotheses, see SessionEvidence."""
    logits = motion.logits(weights)
    none = logits[NONE]
    logits |= {name: none + odds for name, odds in of_images.items()}
    strange = none + float(weights.strangeness * np.log(motion.over_usual / weights.strange))
    logits[UNKNOWN] = float(np.logaddexp(strange, logits.get(UNKNOWN, -np.inf)))
    return motion.with_looks(logits, weights)


def promising(
    base: JointFit,
    fits: Mapping[str, JointFit],
    effects: Sequence[Effect],
    errors: ModelErrors,
    most: int,
    plain: JointFit | None = None,
    fitted: Sequence[str] = (),
    learned: Mapping[str, float] | None = None,
) -> list[Effect]:
    """Effects with most evidence, those that the base model may have aside: their fit is there.

    Stand-ins that are not far behind the best of them come beside, and so does what no cloth could be like
    around the base model and promises more than the least of them: a fit may find a cloth that can. So does
    what the learned decision holds most probable, whatever it promises: it looks at the motion alone, and
    the tangents around the base model say little of an effect whose cloth has another stiffness.

    Args:
        base: the base model.
        fits: of every effect, or what the linearised model says of it.
        effects: that move the cloth, and stand-ins.
        errors: of the base model.
        most: effects at most, stand-ins aside.
        plain: see session_evidence.
        fitted: effects that have been fitted.
        learned: probabilities of the learned decision, see session_evidence.
    """
    promised = {name: replace(fit, possible=True) for name, fit in fits.items()}
    evidence = _of_motion(base, promised, errors, None, {}, plain)
    nats = {name: evidence.nats(name) for name in fits if name not in fitted}
    names = sorted((name for name in nats if name not in STAND_INS), key=lambda name: -nats[name])
    possible = [name for name in names if fits[name].possible]
    ranked = [name for name in possible[:most] if nats[name] > _WORTH]
    least = min([nats[name] for name in ranked], default=_WORTH)
    near = max([_WORTH, *(nats[name] - _NEAR for name in ranked)])
    ranked += [name for name in names if not fits[name].possible and nats[name] > least]
    ranked += [name for name in nats if name in STAND_INS and nats[name] > near]
    if learned is not None and names:
        ranked.append(max(names, key=lambda name: learned.get(name, 0.0)))
    return [effect for effect in effects if effect.NAME in ranked]


def _of_motion(
    base: JointFit,
    fits: Mapping[str, JointFit],
    errors: ModelErrors,
    learned: Mapping[str, float] | None,
    usual: Mapping[str, float],
    plain: JointFit | None = None,
) -> MotionEvidence:
    own = {}
    for name, fit in fits.items():
        against = plain if plain is not None and name in base.names else base
        own[name] = fit.evidence(against)
    return MotionEvidence(errors, own, learned, usual)


def _of_images(
    effect: Effect, name: str, clips: Sequence[Mapping[str, Finding]], devices: Sequence[int]
) -> Finding:
    """What the images of all clips say: the clip that says most, or the device whose clips say most together.

    The clip of an effect that belongs to a clip, and of one that belongs to the cloth all clips together.
    """
    if effect.SCOPE is Scope.CLIP:
        groups: Sequence[int] = range(len(clips))
    else:
        groups = devices if effect.SCOPE is Scope.DEVICE else [0] * len(clips)
    found: dict[int, list[Finding]] = {}
    for clip, group in zip(clips, groups, strict=True):
        if name in clip:
            found.setdefault(group, []).append(clip[name])
    return max(map(_together, found.values()), key=lambda one: one.log_evidence)


def _together(found: Sequence[Finding]) -> Finding:
    """What several clips say of the same numbers, less what they lose by having to agree on them.

    A clip's evidence falls with the squared distance from its own numbers and is gone at zero, where the
    effect does nothing. Where clips cannot agree it is what the one that says most does, and what speaks
    against any such effect: a mean that none of them has is no answer.
    """
    best = max(found, key=lambda one: one.log_evidence)
    if len(found) == 1:
        return best
    mean, deviation = {}, {}
    for parameter in best.mean:
        precision = np.array([max(one.deviation[parameter], 1e-9) ** -2 for one in found])
        values = np.array([one.mean[parameter] for one in found])
        mean[parameter] = float((precision * values).sum() / precision.sum())
        deviation[parameter] = float(precision.sum() ** -0.5)
    agreed = sum(_at(one, mean) for one in found)
    against = sum(min(one.log_evidence, 0.0) for one in found if one is not best)
    alone = best.log_evidence + against
    return Finding(agreed, mean, deviation) if agreed >= alone else replace(best, log_evidence=alone)


def _at(one: Finding, mean: Mapping[str, float]) -> float:
    """Evidence of a clip for these numbers instead of its own."""
    squares = {p: max(deviation, 1e-9) ** -2 for p, deviation in one.deviation.items()}
    away = sum(squares[p] * (one.mean[p] - value) ** 2 for p, value in mean.items())
    from_zero = sum(squares[p] * one.mean[p] ** 2 for p in mean)
    if one.log_evidence <= 0 or from_zero == 0:
        return one.log_evidence
    return one.log_evidence * (1 - away / from_zero)


def _chances(logits: Mapping[str, float]) -> dict[str, float]:
    names = list(logits)
    values = softmax(np.array([logits[name] for name in names]))
    order = np.argsort(-values, kind="stable")
    return {names[i]: float(values[i]) for i in order}
