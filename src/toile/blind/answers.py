"""Answers of a diagnosis as a blind check reads them: ``diagnosis.json`` with what sessions add to it.

Beside the keys of ``diagnosis.record``, at the top, in ``verdict`` or in ``session``:

- ``probabilities``: {name: probability}, ``none`` and ``unknown`` among them
- ``set``: names of the 90 % set, else ``verdict.candidates``
- ``class``: names that are one answer with the verdict's effect
- ``equivalence_classes``: [[name]], what this session cannot tell apart, as declared
- ``baselines``: {name: effect, or {``effect``}}, other answers to the same session
- ``next_recording``: {``motion``, ...} in place of a sentence; of sessions ``next_clip`` and
  ``expected_information``
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from toile.diagnosis.record import AMBIGUOUS, DIAGNOSIS_FILE, NONE, UNKNOWN, GapReport
from toile.errors import InputError
from toile.json_file import read_json_object

_ADDED = ("probabilities", "set", "class", "equivalence_classes", "baselines")
LOSS_DROP = "largest drop of training loss"
"""Name of the baseline that every diagnosis notes."""


@dataclass(frozen=True)
class Answer:
    """An answer to one scene or session.

    Attributes:
        report: what every diagnosis answers.
        probabilities: by name; from the report where none are given.
        candidates: the 90 % set.
        one_answer: names that count as the verdict's effect: itself, and the rest of its class where that is
            within a declared one.
        classes: declared equivalence classes.
        next_motions: what to record next and, after it, what would tell less; () where nothing is said that
            could be done.
        baselines: effect that each of other methods names.
    """

    report: GapReport
    probabilities: Mapping[str, float]
    candidates: tuple[str, ...]
    one_answer: tuple[str, ...]
    classes: tuple[tuple[str, ...], ...]
    next_motions: tuple[str, ...]
    baselines: Mapping[str, str]

    @property
    def next_motion(self) -> str:
        """What to record next, "" where nothing is said that could be done."""
        return next(iter(self.next_motions), "")

    def same(self, name: str) -> frozenset[str]:
        """All names that are one answer with this one."""
        return frozenset({name}).union(*(c for c in self.classes if name in c))


def read_answer(path: Path) -> Answer:
    """Read ``diagnosis.json``.

    Raises:
        InputError: there is none, or anything in it is wrong.
    """
    try:
        values = read_json_object(path)
    except (OSError, ValueError) as error:
        raise InputError(
            "No diagnosis can be read",
            where=str(path),
            expected=f"a {DIAGNOSIS_FILE}",
            got=f"{type(error).__name__}: {error}",
        ) from error
    plain, added, following = _split(values)
    report = GapReport.from_json(plain, str(path))
    try:
        return _answer(report, added, following)
    except (TypeError, ValueError, KeyError, AttributeError) as error:
        raise InputError(
            "The diagnosis cannot be understood",
            where=str(path),
            expected=f"{', '.join(_ADDED)} as docs/diagnosis says",
            got=f"{type(error).__name__}: {error}",
        ) from error


def _split(values: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any], Any]:
    """What the record knows, what is added, and the next recording."""
    verdict = values.get("verdict")
    verdict = dict(verdict) if isinstance(verdict, dict) else {}
    session = values.get("session")
    parts = (session if isinstance(session, dict) else {}, verdict, values)
    added = {k: v for part in parts for k, v in part.items() if k in _ADDED}
    following = values.get("next_recording", verdict.get("next_recording"))
    if parts[0].get("next_clip"):
        gains = parts[0].get("expected_information") or {}
        following = {
            "motion": parts[0]["next_clip"],
            "motions": sorted(gains, key=lambda m: -float(gains[m])),
        }
    plain = {k: v for k, v in values.items() if k not in (*_ADDED, "next_recording")}
    if verdict:
        plain["verdict"] = {k: v for k, v in verdict.items() if k not in _ADDED}
        if not isinstance(plain["verdict"].get("next_recording", ""), str):
            plain["verdict"]["next_recording"] = _motion(following)
    return plain, added, following


def _answer(report: GapReport, added: Mapping[str, Any], following: Any) -> Answer:
    verdict = report.verdict
    probabilities = {str(k): float(v) for k, v in (added.get("probabilities") or {}).items()}
    if not probabilities:
        probabilities = {effect.name: effect.probability for effect in report.effects}
        if verdict.effect == AMBIGUOUS:
            # Which of them is the most probable, and how much, is not said: `none` may be.
            probabilities = {}
        else:
            # Of none and unknown a report says nothing but its verdict.
            probabilities.setdefault(verdict.effect, verdict.probability)
    classes = tuple(tuple(map(str, c)) for c in added.get("equivalence_classes") or ())
    claimed = {verdict.effect, *map(str, added.get("class") or ())}
    # Only what was declared for the session counts: a class of all effects would always be right.
    declared = any(claimed - {verdict.effect} <= set(c) for c in classes)
    baselines = {
        str(name): str(value["effect"] if isinstance(value, Mapping) else value)
        for name, value in (added.get("baselines") or {}).items()
    }
    if report.protocol.naive:
        baselines.setdefault(LOSS_DROP, report.protocol.naive)
    return Answer(
        report=report,
        probabilities=probabilities,
        candidates=tuple(map(str, added.get("set") or verdict.candidates)),
        one_answer=tuple(sorted(claimed if declared else {verdict.effect})),
        classes=tuple(c for c in classes if not {NONE, UNKNOWN} & set(c)),
        next_motions=_motions(following),
        baselines=baselines,
    )


def _motion(following: Any) -> str:
    return str(following.get("motion", "")) if isinstance(following, Mapping) else ""


def _motions(following: Any) -> tuple[str, ...]:
    first = _motion(following)
    others = following.get("motions", ()) if isinstance(following, Mapping) else ()
    return tuple(dict.fromkeys((first, *map(str, others)))) if first else ()
