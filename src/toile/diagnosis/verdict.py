"""The answer in words."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

from pydantic import Field

from toile.diagnosis.decision import NONE, UNKNOWN, Calibration, confidence_set
from toile.diagnosis.record import AMBIGUOUS, Shrink, Verdict
from toile.diagnosis.recordings import next_recording
from toile.effects.base import Stage
from toile.effects.catalogue import OUTLINED, STAGES
from toile.limits import Fraction, NonNegative


@dataclass(frozen=True)
class VerdictSettings:
    """When an answer is given.

    Attributes:
        level: probability that the candidates hold together.
        likely: probability from which on the most probable hypothesis can be the answer.
        named: the same where it is an effect: a false alarm costs more than no answer.
        ahead: how many times as probable as the second one it must be.
        beside: score over the calibrated threshold from which on an effect of another stage acts beside it.
    """

    level: Annotated[float, Field(gt=0, le=1)] = 0.9
    likely: Fraction = 0.5
    named: Fraction = 0.5
    ahead: Annotated[float, Field(ge=1, allow_inf_nan=False)] = 3.0
    beside: NonNegative = 2.0

    def needed(self, name: str) -> float:
        """Probability from which on a hypothesis can be the answer."""
        return self.likely if name == NONE else max(self.likely, self.named)


DEFAULT = VerdictSettings()


def is_clear(found: Mapping[str, float], settings: VerdictSettings = DEFAULT) -> bool:
    """Whether the most probable hypothesis is the answer: likely enough, and far ahead."""
    name = max(found, key=lambda one: found[one])
    others = max((p for one, p in found.items() if one != name), default=0.0)
    return found[name] >= settings.needed(name) and found[name] >= settings.ahead * others


def verdict_of(
    found: Mapping[str, float],
    evidence: Mapping[str, float],
    calibration: Calibration,
    shrinks: Mapping[str, Shrink],
    *,
    explained: bool = True,
    clips: int = 1,
    settings: VerdictSettings = DEFAULT,
) -> Verdict:
    """The verdict from probabilities, most probable first, and the evidence they come from.

    Args:
        found: probabilities.
        evidence: log evidence by effect.
        calibration: see Calibration.
        shrinks: of held-out errors, by effect.
        explained: whether the best model leaves no more of the images than a right one does.
        clips: that it is from.
        settings: see VerdictSettings.
    """
    one, all_of_them = ("this clip", "the clip") if clips == 1 else ("these clips", "the clips")
    candidates = confidence_set(found, settings.level)
    first = candidates[0]
    also = None
    clear = is_clear(found, settings)
    if clear and first != NONE:
        # Another stage leaves a trace of its own: both act. What is unknown is missing in the motion.
        own = STAGES.get(first, Stage.MECHANICS)
        rivals = OUTLINED if first in OUTLINED else ()
        others = {
            name: calibration.score(name, value)
            for name, value in evidence.items()
            if STAGES[name] != own and name not in rivals
        }
        strongest = max(others, key=lambda name: others[name], default=None)
        if strongest is not None and others[strongest] > settings.beside * calibration.threshold:
            also = strongest
    if not clear:
        listed = ", ".join(candidates[:_LISTED])
        if len(candidates) > _LISTED:
            listed += f" and {len(candidates) - _LISTED} more"
        begin = f"Nothing stands out: {one}" if first == NONE else one.capitalize()
        return Verdict(
            AMBIGUOUS,
            candidates,
            _stage_of(candidates),
            _together(found, candidates),
            f"{begin} cannot tell {listed} apart.",
            next_recording(candidates),
        )
    if first == NONE:
        reason = f"The base model explains {all_of_them} to within its noise."
        if not explained:
            reason = f"No effect shows, but no model explains {all_of_them}: no proof that none acts."
        return Verdict(NONE, candidates, NONE, found[NONE], reason, "")
    if first == UNKNOWN:
        return Verdict(
            UNKNOWN,
            candidates,
            UNKNOWN,
            found[UNKNOWN],
            "Forces beyond the usual are missing, and no effect of the catalogue supplies them.",
            next_recording(candidates),
            also,
        )
    reason = f"{first} explains what the base model misses."
    if first in shrinks:
        s = shrinks[first]
        reason += f" Held-out error goes from {s.base:.1f} to {s.with_effect:.1f} mm."
    return Verdict(first, candidates, STAGES[first].value, found[first], reason, "", also)


def of_two(verdict: Verdict, first: str, second: str, probability: float) -> Verdict:
    """The same verdict with a second effect that moves the cloth; clear, if it was not.

    Each of them is missing where the other acts, so that they are no rivals, whichever has more evidence.

    Args:
        verdict: from hypotheses with one effect each.
        first: the most probable of them.
        second: acts beside it.
        probability: that something moves the cloth, and the second one beside the first.
    """
    if verdict.effect not in (AMBIGUOUS, first):
        return verdict
    both = f"{first} and {second}: each explains what the base model with the other misses."
    if verdict.effect == first:
        # There is one place beside the first: where an effect of the image has it, the second is a candidate.
        changed = replace(verdict, also=verdict.also or second, reason=f"{verdict.reason} {both}")
        if changed.also == second:
            return changed
        return replace(changed, candidates=tuple(dict.fromkeys((*verdict.candidates, second))))
    return replace(
        verdict,
        effect=first,
        candidates=tuple(dict.fromkeys((first, second, *verdict.candidates))),
        stage=STAGES[first].value,
        probability=probability,
        reason=both,
        next_recording="",
        also=second,
    )


def of_class(
    verdict: Verdict,
    found: Mapping[str, float],
    classes: Sequence[Sequence[str]],
    settings: VerdictSettings = DEFAULT,
) -> Verdict:
    """Where the candidates that are left are one class, one of it is the answer: none, or the most probable.

    Args:
        verdict: changed where it is ambiguous.
        found: probabilities.
        classes: names that the clips cannot tell apart.
        settings: see VerdictSettings.
    """
    if verdict.effect != AMBIGUOUS:
        return verdict
    for one in classes:
        total = _together(found, one)
        first = NONE if NONE in one else max(one, key=lambda name: found.get(name, 0.0))
        others = max((p for name, p in found.items() if name not in one), default=0.0)
        clear = total >= settings.needed(first) and total >= settings.ahead * others
        if not clear or first == UNKNOWN:
            continue
        what = "nothing else acts" if first == NONE else "one of them is missing"
        return replace(
            verdict,
            effect=first,
            probability=total,
            stage=STAGES[first].value if first in STAGES else first,
            reason=f"{' or '.join(one)}: these clips cannot tell them apart, and {what}.",
        )
    return verdict


def refuted(verdict: Verdict, found: Mapping[str, float], shrinks: Mapping[str, Shrink]) -> Verdict:
    """The same verdict, unless its effect predicts worse what another one predicts better: then both may be.

    Evidence is of what was fitted, and flexible effects may gain there by what they cannot foretell. That an
    effect predicts worse says little by itself: over half a second the error of the start outweighs a weak
    cause, and one that acts may add to it.

    Args:
        verdict: to be checked.
        found: probabilities.
        shrinks: of the error on a whole clip that was left out, by effect.
    """
    if verdict.effect not in overtaken(shrinks):
        return verdict
    better = _foretelling(shrinks)
    candidates = tuple(dict.fromkeys((*verdict.candidates, *better)))
    reason = f"{verdict.effect} has most evidence, but predicts the clip that was left out worse than nothing"
    reason += f"; {', '.join(better)} predicts it better."
    return _ambiguous(verdict, candidates, found, reason)


def overtaken(shrinks: Mapping[str, Shrink]) -> tuple[str, ...]:
    """Effects that predict worse than nothing what another one predicts better, see ``refuted``.

    Args:
        shrinks: of the error on a whole clip that was left out, by effect.
    """
    if not _foretelling(shrinks):
        return ()
    return tuple(name for name, shrink in shrinks.items() if shrink.high < 0)


def _foretelling(shrinks: Mapping[str, Shrink]) -> list[str]:
    return [name for name, s in shrinks.items() if s.low > max(0.0, s.best_placebo or 0.0)]


def unsettled(verdict: Verdict, found: Mapping[str, float], fitted: Collection[str]) -> Verdict:
    """The verdict where the fit of the base model has not arrived: no effect that was fitted is named.

    Effects begin where the base model has ended, so what speaks for one may be what that has still to gain.

    Args:
        verdict: to be checked.
        found: probabilities.
        fitted: effects that are judged by fits beside the base model.
    """
    if verdict.effect not in fitted:
        return verdict
    candidates = tuple(dict.fromkeys((*verdict.candidates, NONE)))
    reason = f"{verdict.effect} has most evidence, but the fit of the base model has not arrived: what "
    reason += "speaks for it may be what that has still to gain."
    return _ambiguous(verdict, candidates, found, reason)


def _ambiguous(
    verdict: Verdict, candidates: tuple[str, ...], found: Mapping[str, float], reason: str
) -> Verdict:
    return replace(
        verdict,
        effect=AMBIGUOUS,
        candidates=candidates,
        stage=_stage_of(candidates),
        probability=_together(found, candidates),
        reason=reason,
        next_recording=next_recording(candidates),
        also=None,
    )


def _together(found: Mapping[str, float], names: Sequence[str]) -> float:
    """Probability of all of them, which rounding makes no more than 1."""
    return min(1.0, math.fsum(found.get(name, 0.0) for name in names))


def _stage_of(candidates: Sequence[str]) -> str:
    """The stage of all of them, or unknown."""
    stages = {STAGES[name].value for name in candidates if name in STAGES}
    return stages.pop() if len(stages) == 1 else UNKNOWN


def until(verdict: Verdict, frame: int) -> Verdict:
    """The same verdict, saying that tracking has lost the cloth in a frame."""
    note = f"Tracking loses the cloth in frame {frame}; only frames before it count."
    return replace(verdict, reason=f"{verdict.reason} {note}")


def seen_in_part(
    verdict: Verdict, found: Mapping[str, float], frames: Sequence[tuple[str, int, int]]
) -> Verdict:
    """The same verdict, saying of which clips tracking has lost the cloth.

    What most frames are missing for is no proof that nothing is missing: ``none`` is ambiguous then.

    Args:
        verdict: from the frames before.
        found: probabilities.
        frames: name of every clip, frames in which its tracked motion is that of the cloth, and all of them.
    """
    lost = [(clip, known) for clip, known, every in frames if known < every]
    if not lost:
        return verdict
    notes = [f"Tracking loses the cloth in frame {known} of {clip}." for clip, known in lost]
    reason = " ".join((verdict.reason, *notes, "Only frames before count."))
    known, every = sum(one[1] for one in frames), sum(one[2] for one in frames)
    if verdict.effect != NONE or 2 * known >= every:
        return replace(verdict, reason=reason)
    reason = " ".join(
        (*notes, f"The {known} frames before, of {every}, are too few to say that nothing acts.")
    )
    return _ambiguous(verdict, verdict.candidates, found, reason)


# Candidates that a sentence holds.
_LISTED = 4
