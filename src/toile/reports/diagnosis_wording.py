"""A diagnosis in sentences: what page, dashboard and terminal say alike, as plain text."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from toile.diagnosis.record import (
    AMBIGUOUS,
    LAST_CLIP,
    MOVED,
    NONE,
    PIECES,
    UNKNOWN,
    GapReport,
    Shrink,
    StandIn,
)
from toile.effects.anchor_slip import AnchorSlip
from toile.effects.base import Scope, Stage
from toile.effects.catalogue import CATALOGUE

_SPOKEN = {
    NONE: "nothing at all",
    UNKNOWN: "something outside the catalogue",
    "contact": "contact with an obstacle",
    "focal_error": "a wrong focal length",
    "frame_rate": "a wrong frame rate",
    "gravity_tilt": "tilted gravity",
    "mask_bias": "a biased mask",
    "shading": "changing light",
    "anisotropic_stiffness": "anisotropic stiffness",
}
"""Names that would not read well in a sentence."""
_NAMED = 3
"""Candidates that a headline names."""
_LIKELY = 0.1
"""Probability from which on the page says what an unknown cause looks like."""
_DIFFERENCES = 3
"""Settings that a caveat names."""
STAGES = {
    Stage.NUMERICS.value: "solver and time step",
    Stage.ACTUATION.value: "pinned vertices, gusts",
    Stage.MECHANICS.value: "cloth, air and obstacles",
    Stage.CAMERA.value: "focal length and lens",
    Stage.APPEARANCE.value: "light and exposure",
    Stage.OBSERVATION.value: "the masks",
}
"""What belongs to every stage, from forces to pixels."""


def spoken(name: str) -> str:
    """An effect's name, or NONE or UNKNOWN, as it stands in a sentence."""
    return _SPOKEN.get(name, name.replace("_", " "))


def plain_name(name: str) -> str:
    """An effect's name without underscores."""
    return {NONE: "nothing missing", UNKNOWN: "outside the catalogue"}.get(name, name.replace("_", " "))


def listed(names: Sequence[str], last: str) -> str:
    """Names as "a, b or c" with ``last`` = "or"."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} {last} {names[-1]}"


def percent(share: float) -> str:
    """A share as a whole percentage; probabilities are neither 0 nor 1."""
    if 0 < share < 0.005:
        return "< 1 %"
    if 0.995 < share < 1:
        return "> 99 %"
    return f"{100 * share:.0f} %".replace("-", "−")


def amount(share: float) -> str:
    """A share of an error as a percentage, below 1 % to a tenth; what rounds to nothing has no sign."""
    text = f"{100 * share:.0f}" if abs(share) >= 0.0095 else f"{100 * share:.1f}"
    return "0 %" if float(text) == 0 else f"{text} %".replace("-", "−")


def change(less: float) -> str:
    """How an error changes that falls by a share of itself: "−60 %", "+0.4 %", "no change"."""
    text = amount(-less)
    return "no change" if text == "0 %" else text if text.startswith("−") else f"+{text}"


def change_between(low: float, high: float) -> str:
    """The interval of ``change``: "−68 % to −52 %"; "" where both ends read alike."""
    ends = [amount(-high), amount(-low)]
    signed = [text if text.startswith("−") or text == "0 %" else f"+{text}" for text in ends]
    return "" if ends[0] == ends[1] else " to ".join(signed)


def is_uncalibrated(report: GapReport) -> bool:
    """Whether the report says that its probabilities were not calibrated for its settings."""
    return report.calibration is not None and not report.calibration.calibrated


def mark(report: GapReport) -> str:
    """What follows a probability: nothing, or that it is uncalibrated."""
    return ", uncalibrated" if is_uncalibrated(report) else ""


def calibration_caveat(report: GapReport) -> str:
    """What the probabilities of an uncalibrated diagnosis are worth, "" for a calibrated one."""
    use = report.calibration
    if use is None or use.calibrated:
        return ""
    shown = "; ".join(use.differences[:_DIFFERENCES])
    more = len(use.differences) - _DIFFERENCES
    others = f"; and {more} more" if more > 0 else ""
    return (
        "Uncalibrated: no scenes with known effects were diagnosed with these settings, so the probabilities "
        f"only rank the candidates. ({shown}{others}.)"
    )


def clips_of(report: GapReport) -> str:
    """What was diagnosed."""
    several = report.session is not None and len(report.session.clips) > 1
    return "these clips" if several else "this clip"


def answer(report: GapReport) -> str:
    """The answer in one sentence."""
    verdict = report.verdict
    if verdict.effect == NONE:
        # While others are in the set, nothing is all that one sees, and no more than that.
        alone = set(verdict.candidates) <= {NONE}
        if alone:
            return f"No effect is missing: the model explains {clips_of(report)}."
        return f"No missing effect shows in {clips_of(report)}."
    if verdict.effect == UNKNOWN:
        return "The gap is real, and its cause is outside the catalogue."
    if verdict.effect == AMBIGUOUS:
        names = [spoken(name) for name in verdict.candidates] or ["several causes"]
        if len(names) > _NAMED + 1:
            names = [*names[:_NAMED], f"one of {len(names) - _NAMED} others"]
        text = listed(names, "or")
        if len(verdict.candidates) == 1:
            return f"Perhaps {text}: {clips_of(report)} cannot settle it."
        return f"{text[:1].upper()}{text[1:]}: {clips_of(report)} cannot tell."
    names = [spoken(verdict.effect), *([spoken(verdict.also)] if verdict.also else [])]
    return f"The gap is {listed(names, 'and')}."


def _alike_in_answer(report: GapReport) -> tuple[str, ...]:
    """Names whose probabilities the answer has together, as the clips cannot tell them apart; () for one."""
    session, verdict = report.session, report.verdict
    if session is None or verdict.effect in (AMBIGUOUS, UNKNOWN):
        return ()
    own = session.probabilities.get(verdict.effect, 0.0)
    if verdict.also or verdict.probability <= own + 1e-9:
        return ()
    for one in session.equivalence_classes:
        if verdict.effect in one:
            return tuple(sorted(one, key=lambda name: -session.probabilities.get(name, 0.0)))
    return ()


def told_apart(report: GapReport, group: Sequence[str]) -> str:
    """Where the answer is one of a group whose traces are alike, and not the others: that fits tell it.

    Traces are to first order and under the law; fits go on, and causes from outside are judged beside free
    forces as well, where the balance of torques tells what is alike under the law.
    """
    verdict = report.verdict
    others = [name for name in group if name != verdict.effect]
    if verdict.effect not in group or NONE in group or _alike_in_answer(report):
        return ""
    if set(others) & {*verdict.candidates, verdict.also}:
        return ""
    return f"to first order; what was fitted speaks for {spoken(verdict.effect)}"


def _of_alike(report: GapReport, alike: Sequence[str], probability: str, stage: str) -> str:
    """``certainty`` where the answer is one of several that clips cannot tell apart."""
    verdict = report.verdict
    causes = [spoken(name) for name in alike if name != NONE]
    if verdict.effect == NONE:
        that = f"nothing is missing, or {listed(causes, 'or')}, which {clips_of(report)} would not show"
    else:
        that = f"it is one of {listed(causes, 'and')}, which {clips_of(report)} cannot tell apart"
    left = [spoken(name) for name in verdict.candidates if name not in alike]
    parts = [f"Probability {probability} that {that}.", stage]
    parts += [f"Not excluded: {listed(left, 'and')}."] if left else []
    return " ".join(part for part in parts if part)


def certainty(report: GapReport) -> str:
    """How sure the answer is, and where along the way from forces to pixels it lies."""
    verdict = report.verdict
    probability = f"{percent(verdict.probability)}{' (uncalibrated)' if is_uncalibrated(report) else ''}"
    stage = f"It acts in the {verdict.stage} stage." if verdict.stage in STAGES else ""
    others = [spoken(c) for c in verdict.candidates if c not in (verdict.effect, verdict.also)]
    excluded = f" Not excluded: {listed(others, 'and')}." if others else ""
    if alike := _alike_in_answer(report):
        return _of_alike(report, alike, probability, stage)
    if verdict.effect == NONE:
        return f"Probability {probability} that nothing is missing.{excluded}"
    if verdict.effect == UNKNOWN:
        text = f"Probability {probability}: something is missing that no effect of the catalogue is."
        return text + excluded
    if verdict.effect == AMBIGUOUS:
        found = {effect.name: effect.probability for effect in report.effects}
        each = [f"{plain_name(c)} {percent(found[c])}" for c in verdict.candidates if c in found]
        beside = [plain_name(c) for c in verdict.candidates if c not in found]
        if beside:
            left = verdict.probability - sum(found.get(c, 0.0) for c in verdict.candidates)
            each.append(f"{listed(beside, 'or')} {percent(max(left, 0.0))}")
        if len(each) == 1 and not beside:
            return f"Probability {probability}. {stage}".strip()
        text = f"Together they hold {probability} of the probability"
        text += f": {', '.join(each)}." if each else "."
        return f"{text} Every effect among them acts in the {verdict.stage} stage." if stage else text
    return f"Probability {probability}. {stage}".strip() + excluded


def obstacles(report: GapReport) -> list[str]:
    """One sentence for every clip in which something may be touched that nobody knows of."""
    found = {} if report.session is None else report.session.obstacles
    return [
        f"In {clip} the cloth may touch {_obstacle(at)}, in the camera's frame." for clip, at in found.items()
    ]


_LOOKS = {
    "steady_forces": "a field of forces that does not change",
    "pressure": "a pressure on one side, which follows the cloth's normals",
    "rest_length_drift": "sides that become longer or shorter while they are filmed",
}


def stand_ins(report: GapReport) -> list[str]:
    """What a cause that the catalogue lacks looks like, one sentence for each that is likely enough."""
    found = {} if report.session is None else report.session.stand_ins
    return [
        f"What the catalogue lacks may look like {_LOOKS[name]} ({percent(one.probability)}): "
        f"{', '.join(_measure(what, value) for what, value in one.found.items())}; {_moves(one)}."
        for name, one in found.items()
        if one.probability >= _LIKELY
    ]


def _moves(one: StandIn) -> str:
    if one.moves is None:
        return "a simulated cloth is torn apart by it"
    return f"it moves the cloth by {100 * one.moves:.1f} % of its width"


def resized(report: GapReport) -> list[str]:
    """Clips in which the cloth seems to become smaller or larger, one sentence each."""
    found = {} if report.session is None else report.session.resized
    return [
        f"In {clip} the sides of the cloth seem to become {100 * abs(share):.1f} % "
        f"{'shorter' if share < 0 else 'longer'} while what holds it stands still: they do, or the camera "
        "zooms or moves, or somebody moved what holds it."
        for clip, share in found.items()
    ]


def covered(report: GapReport) -> list[str]:
    """Clips in which something seems to be before the cloth, one sentence each."""
    found = {} if report.session is None else report.session.covered
    return [
        f"In {clip} up to {100 * one.share:.0f} % of the print is gone between frames {one.first} "
        f"and {one.last}: something passes before it that the masks take for cloth."
        for clip, one in found.items()
    ]


def where_it_acts(report: GapReport) -> str:
    """What the map of the effect that is named shows."""
    effect = report.verdict.effect
    if effect == AnchorSlip.NAME:
        return "How near the cloth is to the holder that slips."
    return f"How strongly {spoken(effect)} acts on the cloth, by its own fit."


def unseen(report: GapReport) -> str:
    """What may act although nothing shows, "" where the answer is another one or everything would show."""
    if report.session is None or report.verdict.effect != NONE or not report.session.unseen:
        return ""
    names = listed([spoken(name) for name in report.session.unseen], "or")
    return (
        f"These clips would not show {names}, however strong: what that does the base model has already, by "
        "its stiffness, its steady wind or how the cloth begins."
    )


def _measure(what: str, value: float) -> str:
    name, unit = what.rstrip("]").split(" [")
    return f"{name} {value:+.2g} {unit}" if unit == "%" else f"{name} {value:.2g} {unit}"


def _obstacle(at: Mapping[str, Sequence[float]]) -> str:
    if "centre" in at:
        return f"something round, {at['radius'][0]:.2f} m in radius, about ({_numbers(at['centre'])}) m"
    return f"something flat at ({_numbers(at['point'])}) m that faces ({_numbers(at['normal'])})"


def _numbers(values: Sequence[float]) -> str:
    return ", ".join(f"{value:.2f}" for value in values)


def shrinkage(shrink: Shrink, name: str = "") -> str:
    """How far the held-out error falls, and whether more than with a placebo.

    Args:
        shrink: see Shrink.
        name: of the effect.
    """
    what, unit = metric_and_unit(shrink.metric)
    unseen = "" if shrink.held_out.startswith(PIECES) else ", which no fit has seen,"
    if shrink.held_out == LAST_CLIP and name in CATALOGUE and CATALOGUE[name].SCOPE is Scope.CLIP:
        unseen = f", which no fit has seen but that of its own {plain_name(name)},"
    seen = f"On {shrink.held_out}{unseen} the error ({what})"
    by = amount(abs(shrink.estimate))
    if by == "0 %":
        text = f"{seen} stays at {shrink.base:.3g} {unit}".rstrip()
    else:
        falls = shrink.estimate >= 0
        numbers = f"from {shrink.base:.3g} to {shrink.with_effect:.3g} {unit}".strip()
        # Said of what is less, or of what is more.
        one_way = shrink.low * shrink.high >= 0
        ends = sorted(abs(v) if one_way else v if falls else -v for v in (shrink.low, shrink.high))
        first, last = map(amount, ends)
        between = "" if first == last else f" ({first} to {last})"
        text = (
            f"{seen} {'falls' if falls else 'grows'} {numbers}: {by} {'less' if falls else 'more'}{between}"
        )
    if shrink.best_placebo is None:
        return f"{text}."
    gain = amount(shrink.best_placebo)
    if beats_placebo(shrink):
        return f"{text}; the best placebo reaches {gain}."
    return f"{text}. That is not clearly more than the best placebo's {gain}, so no shrinkage is claimed."


def when_moved(report: GapReport) -> str:
    """In which frames the most probable effect moves the cloth; "" where that is not known."""
    session = report.session
    if session is None or not session.moved:
        return ""
    frames = [frame for frame, by in enumerate(session.moved) if by > MOVED]
    name, least = plain_name(session.moved_by), f"{100 * MOVED:g} % of its width"
    if not frames:
        return f"The most probable effect on the motion, {name}, nowhere moves the cloth by {least}."
    largest = max(range(len(session.moved)), key=lambda frame: session.moved[frame])
    return (
        f"The most probable effect on the motion, {name}, would move the cloth of the first clip by more "
        f"than {least} in frames {frame_ranges(frames)}, most in frame {largest} "
        f"({100 * session.moved[largest]:.1f} %)."
    )


def what_acts_beside(report: GapReport) -> str:
    """What moves the cloth beside the effect that it was asked of; "" where that was not asked."""
    session = report.session
    if session is None or not session.beside:
        return ""
    name, probability = max(session.beside.items(), key=lambda item: item[1])
    first, sure = plain_name(session.first or session.moved_by), percent(probability)
    if name == NONE:
        return f"Beside {first} no other effect shows in the motion: {sure}{mark(report)}."
    nothing = percent(session.beside.get(NONE, 0.0))
    text = f"Beside {first}: {plain_name(name)} {sure}, nothing else {nothing}{mark(report)}"
    both = {report.verdict.effect, report.verdict.also} == {session.first or session.moved_by, name}
    if both:
        return f"{text}. Both are the answer."
    shrink = session.second_shrink
    if shrink is not None and shrink.high < 0:
        worse = percent(-shrink.estimate)
        return f"{text}. With both, {shrink.held_out} is predicted {worse} worse, so it is not named."
    believed = "Enough to name a second effect" if session.second else "Not enough to name a second effect"
    return f"{text}. {believed}."


def beats_placebo(shrink: Shrink) -> bool:
    """Whether the lower end of the interval is above the best placebo, and above nothing."""
    return shrink.low > max(0.0, shrink.best_placebo or 0.0)


def doubt(shrink: Shrink) -> str:
    """What the held-out error says against an effect, in two words; "" for nothing."""
    if shrink.high < 0:
        return "predicts worse"
    return "" if beats_placebo(shrink) else "within placebo"


def metric_and_unit(metric: str) -> tuple[str, str]:
    """("distance", "mm") from "distance [mm]"."""
    found = re.fullmatch(r"(.*\S)\s*\[(.+)\]", metric)
    return (found[1], found[2]) if found else (metric, "")


def frame_ranges(frames: Sequence[int]) -> str:
    """Indices as "0 to 29, 35"; "none" for no frames."""
    ranges: list[list[int]] = []
    for frame in sorted(frames):
        if ranges and frame == ranges[-1][1] + 1:
            ranges[-1][1] = frame
        else:
            ranges.append([frame, frame])
    return ", ".join(str(a) if a == b else f"{a} to {b}" for a, b in ranges) or "none"
