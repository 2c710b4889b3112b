"""Opening the labels of a set and marking the predictions: tables, confusion matrix, shrink figure."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from toile.atomic_file import write_text, written_atomically
from toile.blind.measures import confusion, detection, mark, measured
from toile.blind.run import Predictions, read_predictions
from toile.blind.sealing import BlindSet, SealKey, read_commitments
from toile.blind.tables import by_effect, by_generator, limits, over_naive
from toile.errors import InputError
from toile.json_file import read_json_object

SHRINKS = {
    "shrink_true": "true effect",
    "shrink_runner_up": "runner-up",
    "shrink_placebo": "best placebo",
}


@dataclass(frozen=True)
class Grade:
    """What grading has found.

    Attributes:
        marks: one row per scene, see blind_measures.mark.
        measures: the table of measures, see blind_measures.measured.
        confusion: see blind_measures.confusion.
        detection: see blind_measures.detection.
        generators, effects, limits, over_naive: see blind_tables.
        predictions: hash of the graded predictions.
        blind: whether nobody could have known the labels (the key was drawn, not made from a seed).
    """

    marks: pd.DataFrame
    measures: pd.DataFrame
    confusion: pd.DataFrame
    detection: pd.DataFrame
    generators: pd.DataFrame
    effects: pd.DataFrame
    limits: pd.DataFrame
    over_naive: pd.DataFrame
    predictions: str
    blind: bool


def grade_set(
    blind: BlindSet,
    predictions: Predictions,
    key: SealKey,
    *,
    alias: float = 0.9,
    resamplings: int = 2000,
    seed: int = 0,
) -> Grade:
    """Check every hash, open every label, mark every scene.

    Args:
        blind: the set.
        predictions: of run_blind, hashed.
        key: of the set.
        alias: |cosine| from which two effects count as one class on a clip.
        resamplings: of scenes, for the intervals.
        seed: of the resamplings.

    Raises:
        InputError: predictions or labels have changed, the key is another one, or other predictions have been
            graded before.
    """
    found = read_predictions(blind, predictions)
    digest = predictions.hash.read_text().strip()
    if blind.read_description()["key"] != key.fingerprint:
        raise InputError(
            "The key is not the set's", where="key", expected="the key of this set", got="another key"
        )
    commitments = read_commitments(blind.commitments)
    if set(commitments) != set(blind.names()):
        raise InputError(
            "Commitments do not fit the set",
            where=str(blind.commitments),
            expected=f"one for each of {len(blind.names())} scenes",
            got=str(len(commitments)),
        )
    spend(blind, digest)
    labels = {name: blind.open(key, name) for name in sorted(found)}
    marks = pd.DataFrame(
        [
            mark(name, labels[name], found[name], predictions.diagnosis(name).parent, alias=alias)
            for name in sorted(found)
        ]
    )
    for column in ("identifiable", "naive_top1"):
        if column not in marks.columns:
            marks[column] = None
    return Grade(
        marks=marks,
        measures=measured(marks, resamplings=resamplings, seed=seed),
        confusion=confusion(marks),
        detection=detection(marks),
        generators=by_generator(marks, resamplings=resamplings, seed=seed),
        effects=by_effect(marks),
        limits=limits(found.values()),
        over_naive=over_naive(marks, resamplings=resamplings, seed=seed),
        predictions=digest,
        blind=bool(blind.read_description()["blind"]),
    )


def write_grade(grade: Grade, folder: Path) -> list[Path]:
    """Write the tables as CSV and Markdown, the figure, and what was graded; returns the paths."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    tables = {
        "measures": grade.measures,
        "scenes": grade.marks,
        "confusion": grade.confusion.reset_index(),
        "detection": grade.detection,
        "generators": grade.generators,
        "effects": grade.effects,
        "limits": grade.limits,
        "over_naive": grade.over_naive,
    }
    for name, table in tables.items():
        path = folder / f"{name}.csv"
        with written_atomically(path) as temporary:
            table.to_csv(temporary, index=False, float_format="%.6g")
        paths.append(path)
    paths.append(write_text(folder / "grade.md", markdown(grade)))
    figure = _shrink_figure(grade.marks, folder / "shrink.svg")
    if figure is not None:
        paths.append(figure)
    values = {"predictions": grade.predictions, "blind": grade.blind, "scenes": len(grade.marks)}
    paths.append(write_text(folder / "graded.json", json.dumps(values, indent=1) + "\n"))
    return paths


def markdown(grade: Grade) -> str:
    """The tables for people."""
    measures = grade.measures.copy()
    measures["value"] = [
        _with_interval(v, low, high)
        for v, low, high in zip(measures["value"], measures["low"], measures["high"], strict=True)
    ]
    measures["naive"] = [_number(v) for v in measures["naive"]]
    measures = measures[["measure", "aim", "value", "reached", "naive", "scenes"]]
    measures.columns = pd.Index(["measure", "aim", "value [95 %]", "reached", "naive baseline", "scenes"])
    kind = "blind" if grade.blind else "not blind: the key comes from a seed"
    detections = grade.detection.map(lambda v: _number(v) if isinstance(v, float) else v)
    return "\n\n".join(
        (
            f"{len(grade.marks)} scenes, {kind}. Predictions sha256 {grade.predictions}.",
            "## Measures\n\n" + measures.to_markdown(index=False),
            "## Confusion matrix\n\nRows: truth. Columns: answer. Pairs are left out.\n\n"
            + grade.confusion.to_markdown(),
            "## Detection\n\nSizes in what the strength of an effect is named in; `predicted` in the unit "
            "of its first parameter.\n\n" + detections.to_markdown(index=False),
            "",
        )
    )


def spend(blind: BlindSet, digest: str) -> None:
    """Note which predictions the labels are opened for, before they are; other ones are refused from then on.

    Sets for development, whose key comes from a seed, may be graded again and again.
    """
    if not blind.read_description()["blind"]:
        return
    path = blind.spent
    if path.is_file():
        before = _graded_before(path)
        if before != digest:
            raise InputError(
                "Other predictions have been graded already",
                where=str(path),
                expected=f"predictions {before[:12]}…; a blind set serves once",
                got=f"{digest[:12]}…",
            )
        return
    write_text(path, json.dumps({"predictions": digest}) + "\n")


def _graded_before(path: Path) -> str:
    try:
        return str(read_json_object(path)["predictions"])
    except (OSError, ValueError, KeyError) as error:
        raise InputError(
            "It cannot be read which predictions were graded already",
            where=str(path),
            expected="opened.json as toile blind grade has written it",
            got=f"{type(error).__name__}: {error}",
        ) from error


def _shrink_figure(marks: pd.DataFrame, path: Path) -> Path | None:
    """Held-out shrink over all single-effect scenes, one dot per scene; None without any."""
    import matplotlib as mpl
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    columns = [c for c in SHRINKS if c in marks.columns]
    values = {SHRINKS[c]: marks.loc[marks["kind"] == "single", c].dropna().astype(float) for c in columns}
    values = {name: v for name, v in values.items() if len(v)}
    if not values:
        return None
    figure = Figure(figsize=(6, 3.2), layout="constrained")
    FigureCanvasSVG(figure)
    axes = figure.add_subplot()
    rng = np.random.default_rng(0)
    for place, (name, v) in enumerate(values.items()):
        axes.scatter(place + rng.uniform(-0.12, 0.12, len(v)), 100 * v, s=14, alpha=0.7, label=name)
        axes.hlines(100 * v.median(), place - 0.25, place + 0.25, color="black", lw=1.5)
    axes.axhline(0, color="grey", lw=0.8)
    axes.set_xticks(range(len(values)), list(values))
    axes.set_ylabel("held-out error saved [%]")
    axes.set_title("Line: median over single-effect scenes", fontsize=9)
    with mpl.rc_context({"svg.hashsalt": "toile"}), written_atomically(path) as temporary:
        figure.savefig(temporary, format="svg", metadata={"Date": None})
    return path


def _with_interval(value: float, low: float, high: float) -> str:
    return "–" if math.isnan(value) else f"{value:.2f} [{low:.2f}, {high:.2f}]"


def _number(value: float) -> str:
    return "–" if math.isnan(value) else f"{value:.3g}"
