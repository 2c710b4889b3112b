"""Opening the labels of a set of sessions and marking all its predictions at once."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from toile.atomic_file import write_text, written_atomically
from toile.blind.answers import read_answer
from toile.blind.grading import spend
from toile.blind.measures import confusion
from toile.blind.run import Predictions, read_predictions
from toile.blind.sealing import BlindSet, SealKey, read_commitments
from toile.blind.session_aims import aims_section
from toile.blind.session_measures import (
    by_size,
    mark_session,
    measured_sessions,
    reliability,
    with_intervals,
)
from toile.errors import InputError


@dataclass(frozen=True)
class SessionGrade:
    """What grading has found.

    Attributes:
        marks: one row per session and kind of predictions (``clips``), see mark_session.
        measures: see measured_sessions.
        curve: see by_size.
        reliability: see session_measures.reliability.
        confusion: of the first kind of predictions, see measures.confusion.
        predictions: hash of each kind.
        blind: whether nobody could have known the labels.
    """

    marks: pd.DataFrame
    measures: pd.DataFrame
    curve: pd.DataFrame
    reliability: pd.DataFrame
    confusion: pd.DataFrame
    predictions: Mapping[str, str]
    blind: bool


def grade_sessions(
    blind: BlindSet,
    predictions: Mapping[str, Predictions],
    key: SealKey,
    *,
    resamplings: int = 2000,
    seed: int = 0,
) -> SessionGrade:
    """Check every hash, open every label, mark every session once for each kind of predictions.

    Args:
        blind: the set.
        predictions: by what they were made from, e.g. "3", "1" and "3+1" clips; the first is the main one.
        key: of the set.
        resamplings: of sessions, for the intervals.
        seed: of the resamplings.

    Raises:
        InputError: predictions or labels have changed, the key is another one, or other predictions have been
            graded before.
    """
    digests, answered = {}, {}
    for clips, of_kind in predictions.items():
        answered[clips] = {name for name, one in read_predictions(blind, of_kind).items() if one is not None}
        digests[clips] = of_kind.hash.read_text().strip()
    if blind.read_description()["key"] != key.fingerprint:
        raise InputError(
            "The key is not the set's", where="key", expected="the key of this set", got="another key"
        )
    if set(read_commitments(blind.commitments)) != set(blind.names()):
        raise InputError(
            "Commitments do not fit the set",
            where=str(blind.commitments),
            expected=f"one for each of {len(blind.names())} sessions",
            got="others",
        )
    # Labels are opened once for all kinds: answers may not be changed after any of them is marked.
    spend(blind, hashlib.sha256(json.dumps(digests, sort_keys=True).encode()).hexdigest())
    labels = {name: blind.open(key, name) for name in sorted(blind.names())}
    rows = []
    for clips, of_kind in predictions.items():
        for name, sealed in labels.items():
            path = of_kind.diagnosis(name)
            # What was hashed counts, and not what lies there.
            answer = read_answer(path) if name in answered[clips] else None
            seconds = of_kind.seconds(name) if answer is not None else None
            marks = mark_session(name, sealed, answer, path.parent, seconds)
            rows.append({"clips": clips, **marks})
    marks = pd.DataFrame(rows)
    main = marks[marks["clips"] == next(iter(predictions))]
    return SessionGrade(
        marks=marks,
        measures=measured_sessions(marks, resamplings=resamplings, seed=seed),
        curve=by_size(marks),
        reliability=reliability(marks),
        confusion=confusion(main),
        predictions=digests,
        blind=bool(blind.read_description()["blind"]),
    )


def write_session_grade(grade: SessionGrade, folder: Path, table: Path | None = None) -> list[Path]:
    """Write the tables as CSV and Markdown, and what was graded; returns the paths.

    Args:
        grade: see SessionGrade.
        folder: for all of it.
        table: for the table of measures as well.
    """
    folder.mkdir(parents=True, exist_ok=True)
    tables = {
        folder / "measures.csv": grade.measures,
        folder / "sessions.csv": grade.marks,
        folder / "size.csv": grade.curve,
        folder / "reliability.csv": grade.reliability,
        folder / "confusion.csv": grade.confusion.reset_index(),
    }
    if table is not None:
        tables[table] = grade.measures
    for path, values in tables.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        with written_atomically(path) as temporary:
            values.to_csv(temporary, index=False, float_format="%.6g")
    said = {"predictions": dict(grade.predictions), "blind": grade.blind, "sessions": _count(grade)}
    return [
        *tables,
        write_text(folder / "grade.md", markdown(grade)),
        write_text(folder / "graded.json", json.dumps(said, indent=1) + "\n"),
    ]


def markdown(grade: SessionGrade) -> str:
    """The tables for people: measures by generator and number of clips, with intervals."""
    shown = grade.measures.copy()
    shown["value"] = with_intervals(shown)
    shown["column"] = [f"{g}, {c}" for g, c in zip(shown["generator"], shown["clips"], strict=True)]
    order = list(dict.fromkeys(shown["column"]))
    wide = shown.pivot(index="measure", columns="column", values="value")
    wide = wide.loc[list(dict.fromkeys(shown["measure"])), order]
    kind = "blind" if grade.blind else "not blind: the key comes from a seed"
    hashes = "; ".join(f"{clips} clips: {digest}" for clips, digest in grade.predictions.items())
    sizes = grade.curve[(grade.curve["scenes"] > 0) & (grade.curve["generator"] == "all")]
    return "\n\n".join(
        (
            f"{_count(grade)} sessions, {kind}. Predictions sha256 {hashes}. Once graded, a set is "
            "development data.",
            aims_section(grade.measures),
            "## Measures\n\nColumns: generator, clips. Value [95 % interval], sessions.\n\n"
            + wide.to_markdown(),
            "## Named rightly over size\n\n" + sizes.to_markdown(index=False, floatfmt=".2f"),
            "## Reliability\n\n" + grade.reliability.to_markdown(index=False, floatfmt=".2f"),
            "## Confusion matrix\n\nRows: truth. Columns: answer. Pairs are left out.\n\n"
            + grade.confusion.to_markdown(),
            "",
        )
    )


def _count(grade: SessionGrade) -> int:
    return int(grade.marks["scene"].nunique())
