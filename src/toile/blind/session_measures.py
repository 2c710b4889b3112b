"""Marks of sessions: one row per session and way of answering, and the table of measures over them."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.stats import binomtest
from sklearn.metrics import f1_score

from toile.blind.answers import Answer
from toile.blind.measures import (
    CONFIDENT,
    kind_of,
    localisation,
    magnitude,
    shrink_marks,
    size_in_label,
    truth_of,
)
from toile.blind.sealing import Sealed
from toile.diagnosis.record import AMBIGUOUS, MOVED, NONE, UNKNOWN
from toile.effects.base import Stage
from toile.effects.catalogue import STAGES

Array = NDArray[np.float64]

LARGE = 3.0
"""Size from which the table asks for a name [% of the width]; 3 % is asked for, so a bit less is made."""
_TOLERANCE = 0.75
BINS = 10
"""Of stated probabilities, of equal width."""
_OF_THE_IMAGE = (Stage.CAMERA, Stage.APPEARANCE, Stage.OBSERVATION)


def mark_session(
    name: str, sealed: Sealed, answer: Answer | None, folder: Path, seconds: float | None
) -> dict[str, Any]:
    """Marks of one session; one without an answer is wrong in everything.

    A name counts as right where it is the truth or one answer with it, as the diagnosis has declared for this
    session (``equivalence_classes``). Sets are counted in classes, not in names.

    Args:
        name: of the session.
        sealed: its open label.
        answer: of a diagnosis, None if there is none.
        folder: of the answer.
        seconds: it took, None if that is not known.

    Returns:
        Cells by column; NaN (or None) where a mark does not apply.
    """
    label = sealed.label
    truth = truth_of(label)
    kind = kind_of(label)
    row: dict[str, Any] = {
        "scene": name,
        "generator": label.get("generator", "?"),
        "kind": kind,
        "truth": "+".join(truth),
        "asked": "+".join(label.get("levels", [])),
        "asked_percent": _percent(label.get("levels", [])),
        "gap_percent": float(label["magnitude"]["mean_last_third"]),
        "size": size_in_label(label),
        "of_the_image": kind == "single" and STAGES[truth[0]] in _OF_THE_IMAGE,
        "seconds": seconds,
    }
    if answer is None:
        # Wrong in everything that is asked of it.
        wrong = dict.fromkeys(("right", "set_right", "pair_right", "abstains"), False)
        return row | {"answer": "no diagnosis", **wrong, "false_alarm": True, "confidently_wrong": True}
    verdict = answer.report.verdict
    first = first_clip(sealed)
    row |= {
        "answer": verdict.effect,
        "class": ", ".join(answer.one_answer),
        "candidates": ", ".join(answer.candidates),
        "probability": verdict.probability,
        "next_motion": answer.next_motion,
    }
    row |= _marks(answer, truth, verdict.effect, verdict.also)
    row |= _stated(answer, kind, truth)
    for method, named in answer.baselines.items():
        row[f"right [{method}]"] = named == truth[0]
        row[f"false_alarm [{method}]"] = named != NONE
    if kind == "single":
        row |= magnitude(answer.report, first, truth[0])
        row |= shrink_marks(answer.report, verdict, truth[0])
        row["relative_size"] = _relative_size(answer, truth[0])
    row |= localisation(answer.report, _as_reported(answer, sealed), folder)
    if kind in ("single", "pair"):
        row |= _when(answer, label)
    return row


def first_clip(sealed: Sealed) -> Sealed:
    """Label, motion and twin of a session's first clip."""
    frames = sealed.label.get("n_frames")
    if frames is None:
        return sealed
    return Sealed(sealed.label, sealed.vertices[: frames[0]], sealed.twin[: frames[0]])


@dataclass(frozen=True)
class SessionMeasure:
    """One row of the table.

    Attributes:
        name: of the measure.
        column: of the marks.
        select: rows that it is over.
        over: number of the column's values.
        proportion: whether they are 0 or 1.
    """

    name: str
    column: str
    select: Callable[[pd.DataFrame], pd.DataFrame]
    over: Callable[[Array], float] = lambda values: float(values.mean())
    proportion: bool = True

    def of(self, marks: pd.DataFrame, resamplings: int, rng: np.random.Generator) -> dict[str, float]:
        """Value with its 95 % interval (Wilson's for proportions, else by resampling) and the sessions."""
        rows = self.select(marks)
        values = _numbers(rows, self.column)
        n = len(values)
        if not n:
            return {"value": math.nan, "low": math.nan, "high": math.nan, "scenes": 0}
        value = self.over(values)
        if self.proportion:
            low, high = wilson(int(values.sum()), n)
        else:
            low, high = resampled(lambda chosen: self.over(values[chosen]), n, resamplings, rng)
        return {"value": value, "low": low, "high": high, "scenes": n}


def session_measures(marks: pd.DataFrame) -> tuple[SessionMeasure, ...]:
    """The rows of the table; those of baselines follow from the columns that the marks have."""

    def kinds(*names: str) -> Callable[[pd.DataFrame], pd.DataFrame]:
        return lambda rows: rows[rows["kind"].isin(names)]

    def moving(rows: pd.DataFrame) -> pd.DataFrame:
        return rows[(rows["kind"] == "single") & ~rows["of_the_image"].astype(bool)]

    def large(rows: pd.DataFrame) -> pd.DataFrame:
        return moving(rows)[
            lambda r: (r["asked_percent"] >= LARGE) & (r["gap_percent"] >= _TOLERANCE * LARGE)
        ]

    def image(rows: pd.DataFrame) -> pd.DataFrame:
        return rows[rows["of_the_image"].astype(bool)]

    def median(values: Array) -> float:
        return float(np.median(values))

    either = kinds("single", "null")
    own = (
        SessionMeasure("named rightly, effects of 3 % and more", "right", large),
        SessionMeasure("named rightly, all effects that move", "right", moving),
        SessionMeasure("false alarms on nulls", "false_alarm", kinds("null")),
        SessionMeasure("90 % set: coverage", "set_right", either),
        SessionMeasure("90 % set: mean size", "set_size", either, proportion=False),
        SessionMeasure("names that are one answer, mean", "class_size", moving, proportion=False),
        SessionMeasure("outside: abstains", "abstains", kinds("outside")),
        SessionMeasure("outside: confidently wrong", "confidently_wrong", kinds("outside")),
        SessionMeasure("pairs: one right, none wrong", "pair_right", kinds("pair")),
        SessionMeasure(
            "magnitude: median error", "magnitude_error", kinds("single"), median, proportion=False
        ),
        SessionMeasure(
            "magnitude: interval coverage", "magnitude_covered", kinds("single"), proportion=False
        ),
        SessionMeasure(
            "shrink of the true effect, median", "shrink_true", kinds("single"), median, proportion=False
        ),
        SessionMeasure(
            "shrink of the answer, share of the oracle's",
            "share_of_oracle",
            kinds("single"),
            median,
            proportion=False,
        ),
        SessionMeasure(
            "best placebo's shrink, share of the oracle's",
            "placebo_of_true",
            kinds("single"),
            median,
            proportion=False,
        ),
        SessionMeasure("vertices AUPRC", "vertices_auprc", lambda rows: rows, proportion=False),
        SessionMeasure("interval F1", "frames_f1", lambda rows: rows, proportion=False),
        SessionMeasure(
            "interval F1 [every frame]", "frames_f1 [every frame]", lambda rows: rows, proportion=False
        ),
        SessionMeasure("image effects named rightly", "right", image),
        SessionMeasure("time, median [s]", "seconds", lambda rows: rows, median, proportion=False),
    )
    methods = [c.removeprefix("right [") for c in marks.columns if c.startswith("right [")]
    others = [
        SessionMeasure(f"{title} [{method}", f"{column} [{method}", select)
        for method in sorted(methods)
        for title, column, select in (
            ("named rightly, effects of 3 % and more", "right", large),
            ("false alarms on nulls", "false_alarm", kinds("null")),
        )
    ]
    return (*own, *others)


def measured_sessions(marks: pd.DataFrame, *, resamplings: int, seed: int) -> pd.DataFrame:
    """The table: measure, generator ("all" first), clips, value, low, high, scenes.

    Args:
        marks: see mark_session, with a column ``clips``.
        resamplings: of sessions.
        seed: of the resamplings.
    """
    rng = np.random.default_rng(seed)
    rows = []
    for clips, answered in marks.groupby("clips", sort=False):
        generators = sorted(set(answered["generator"]))
        for generator in ("all", *generators):
            chosen = answered if generator == "all" else answered[answered["generator"] == generator]
            place = {"generator": generator, "clips": clips}
            for measure in session_measures(marks):
                rows.append({"measure": measure.name, **place} | measure.of(chosen, resamplings, rng))
            rows.append({"measure": "calibration error", **place} | _calibration(chosen, resamplings, rng))
    columns = ["measure", "generator", "clips", "value", "low", "high", "scenes"]
    return pd.DataFrame(rows, columns=columns)


_SIZE_COLUMNS = ("clips", "generator", "by", "low_edge", "high_edge", "value", "low", "high", "scenes")


def with_intervals(measures: pd.DataFrame) -> list[str]:
    """Value [95 % interval], sessions of every row of the table; a dash where there is none."""
    columns = (measures[name] for name in ("value", "low", "high", "scenes"))
    return [
        "–" if math.isnan(value) else f"{value:.2f} [{low:.2f}, {high:.2f}], {n:.0f}"
        for value, low, high, n in zip(*columns, strict=True)
    ]


def by_size(marks: pd.DataFrame) -> pd.DataFrame:
    """Named rightly over size: clips, generator, by, low_edge, high_edge, value, low, high, scenes.

    ``by`` is "asked" (1, 3 and 7 %), "gap" (bins of what was made [%]), or "detection limit" (bins of the
    estimated strength of the true effect over its predicted limit). Effects of one that move the cloth.
    """
    rows = marks[(marks["kind"] == "single") & ~marks["of_the_image"].astype(bool)]
    edges = {
        "asked": ("asked_percent", (0.0, 2.0, 5.0, math.inf)),
        "gap": ("gap_percent", (0.0, 0.75, 1.5, 2.5, 4.0, 6.0, math.inf)),
        "detection limit": ("relative_size", (0.0, 0.5, 1.0, 2.0, 4.0, 8.0, math.inf)),
    }
    found = []
    for clips, answered in rows.groupby("clips", sort=False):
        for generator in ("all", *sorted(set(answered["generator"]))):
            chosen = answered if generator == "all" else answered[answered["generator"] == generator]
            for by, (column, bounds) in edges.items():
                values = chosen[column] if column in chosen else pd.Series(dtype=float)
                for low_edge, high_edge in pairwise(bounds):
                    inside = chosen.loc[values[(values >= low_edge) & (values < high_edge)].index]
                    right, n = int(_numbers(inside, "right").sum()), len(inside)
                    low, high = wilson(right, n) if n else (math.nan, math.nan)
                    found.append(
                        {
                            "clips": clips,
                            "generator": generator,
                            "by": by,
                            "low_edge": low_edge,
                            "high_edge": high_edge,
                            "value": right / n if n else math.nan,
                            "low": low,
                            "high": high,
                            "scenes": n,
                        }
                    )
    return pd.DataFrame(found, columns=list(_SIZE_COLUMNS))


def reliability(marks: pd.DataFrame) -> pd.DataFrame:
    """Reliability diagram: clips, low_edge, high_edge, stated (mean), right (share), low, high, scenes."""
    found = []
    for clips, answered in marks.groupby("clips", sort=False):
        stated, right = _stated_and_right(answered)
        for k in range(BINS):
            inside = _bin(stated) == k
            n = int(inside.sum())
            if not n:
                continue
            low, high = wilson(int(right[inside].sum()), n)
            found.append(
                {
                    "clips": clips,
                    "low_edge": k / BINS,
                    "high_edge": (k + 1) / BINS,
                    "stated": float(stated[inside].mean()),
                    "right": float(right[inside].mean()),
                    "low": low,
                    "high": high,
                    "scenes": n,
                }
            )
    columns = ["clips", "low_edge", "high_edge", "stated", "right", "low", "high", "scenes"]
    return pd.DataFrame(found, columns=columns)


def calibration_error(stated: Array, right: Array) -> float:
    """Expected calibration error: mean distance of stated probability and share of right answers over bins.

    Args:
        stated: (n,) in [0, 1].
        right: (n,) 0 or 1.

    Source: Naeini, Cooper, Hauskrecht, Obtaining Well Calibrated Probabilities Using Bayesian Binning, 2015.
    Few answers make it larger than it is: with n in a bin it is off by about 0.4 / √n even where all is well.
    """
    bins = _bin(stated)
    total = 0.0
    for k in np.unique(bins):
        inside = bins == k
        total += inside.sum() * abs(stated[inside].mean() - right[inside].mean())
    return float(total / len(stated))


def wilson(right: int, n: int) -> tuple[float, float]:
    """95 % interval of a share by Wilson's formula."""
    found = binomtest(right, n).proportion_ci(method="wilson")
    return float(found.low), float(found.high)


def resampled(
    statistic: Callable[[NDArray[np.int64]], float], n: int, resamplings: int, rng: np.random.Generator
) -> tuple[float, float]:
    """95 % percentile interval of a number of chosen rows (n,) by resampling them."""
    if n < 2:
        value = statistic(np.arange(n))
        return value, value
    values = [statistic(rng.integers(n, size=n)) for _ in range(resamplings)]
    return float(np.quantile(values, 0.025)), float(np.quantile(values, 0.975))


def _marks(answer: Answer, truth: tuple[str, ...], effect: str, also: str | None) -> dict[str, Any]:
    abstained = effect in (AMBIGUOUS, UNKNOWN)
    names = {n for n in (effect, also) if n and n not in (NONE, AMBIGUOUS, UNKNOWN)}
    accepted = set(truth).union(*(answer.same(name) for name in truth))
    # Where the verdict is a whole class, every member of it is that answer.
    is_class = effect == AMBIGUOUS and truth[0] in answer.one_answer
    right = effect == truth[0] or (effect in answer.same(truth[0])) or is_class
    return {
        "right": right,
        "class_size": float(len(answer.one_answer)),
        "false_alarm": effect != NONE and not (effect == AMBIGUOUS and NONE in answer.candidates),
        "set_right": any(name in answer.same(truth[0]) for name in answer.candidates),
        "set_size": float(len({answer.same(name) for name in answer.candidates})),
        "abstains": abstained and not is_class,
        "confidently_wrong": bool(names)
        and not names <= accepted
        and answer.report.verdict.probability >= CONFIDENT,
        "pair_right": bool(names & accepted) and names <= accepted,
    }


def _stated(answer: Answer, kind: str, truth: tuple[str, ...]) -> dict[str, Any]:
    """Largest stated probability, summed over a class, and whether that answer is the truth."""
    if kind == "pair" or not answer.probabilities:
        return {}
    summed: dict[frozenset[str], float] = {}
    for name, probability in answer.probabilities.items():
        members = answer.same(name)
        summed[members] = summed.get(members, 0.0) + probability
    members, stated = max(summed.items(), key=lambda item: item[1])
    wanted = UNKNOWN if kind == "outside" else truth[0]
    return {"stated": min(max(stated, 0.0), 1.0), "stated_right": wanted in members}


def _when(answer: Answer, label: Mapping[str, Any]) -> dict[str, Any]:
    """F1 of the frames in which the first clip's cloth is elsewhere than without the effects.

    The truth is alike for all generators: mean distance to the twin beyond half a percent of the width, where
    that is so in some frames and not in others. The answer's frames are those in which the most probable
    effect moves the cloth as far; beside them what naming every frame would have, which is much, because an
    effect that is there from the start soon shows. Instead of it, where a diagnosis says so, of the frames
    that the generator calls the effect's own.
    """
    session = answer.report.session
    away = np.array(label["magnitude"].get("per_frame_mean", ()), np.float64)
    if session is None or not session.moved or len(session.moved) != len(away):
        return {}
    truth = away > 100 * MOVED
    if truth.all() or not truth.any():
        return {}
    return {
        "frames_f1": float(f1_score(truth, np.array(session.moved) > MOVED)),
        "frames_f1 [every frame]": float(f1_score(truth, np.ones_like(truth))),
    }


def _relative_size(answer: Answer, truth: str) -> float:
    """Estimated strength of the true effect over its predicted detection limit, NaN where one is not known.

    Generators have laws of their own, so the true strength has no number in the catalogue's unit.
    """
    effect = answer.report.effect(truth)
    limit = answer.report.alias.detection_limits.get(truth)
    if effect is None or not effect.parameters or not limit:
        return math.nan
    return abs(next(iter(effect.parameters.values())).estimate) / limit


def _as_reported(answer: Answer, sealed: Sealed) -> Sealed:
    """The label with the frames that the diagnosis has scored: of the first clip, or of all in a row.

    With none where these are others, those of a clip that was recorded later among them.
    """
    counts = sealed.label.get("n_frames")
    if counts is None:
        return sealed
    scored = len(answer.report.where.frames)
    if scored != sum(counts):
        first = first_clip(sealed)
        if scored == counts[0]:
            return first
        unknown = {**first.label.get("localisation", {}), "frames": None}
        return replace(first, label={**first.label, "localisation": unknown})
    begins = np.cumsum([0, *counts[:-1]])
    places = [clip.get("localisation", {}) for clip in sealed.label["clips"]]
    frames = None
    if all(place.get("frames") is not None for place in places):
        frames = [int(b) + f for b, place in zip(begins, places, strict=True) for f in place["frames"]]
    where = {**sealed.label.get("localisation", {}), "frames": frames}
    return Sealed({**sealed.label, "localisation": where}, sealed.vertices, sealed.twin)


def _calibration(rows: pd.DataFrame, resamplings: int, rng: np.random.Generator) -> dict[str, float]:
    stated, right = _stated_and_right(rows)
    n = len(stated)
    if not n:
        return {"value": math.nan, "low": math.nan, "high": math.nan, "scenes": 0}
    low, high = resampled(
        lambda chosen: calibration_error(stated[chosen], right[chosen]), n, resamplings, rng
    )
    return {"value": calibration_error(stated, right), "low": low, "high": high, "scenes": n}


def _stated_and_right(rows: pd.DataFrame) -> tuple[Array, Array]:
    if "stated" not in rows.columns:
        return np.zeros(0), np.zeros(0)
    there = rows[rows["stated"].notna()]
    return there["stated"].to_numpy(np.float64), there["stated_right"].to_numpy(np.float64)


def _bin(stated: Array) -> NDArray[np.int64]:
    return np.minimum((stated * BINS).astype(np.int64), BINS - 1)


def _numbers(rows: pd.DataFrame, column: str) -> Array:
    if column not in rows.columns:
        return np.zeros(0)
    values: Array = rows[column].dropna().to_numpy(np.float64)
    return values


def _percent(levels: Sequence[str]) -> float:
    """Size that was asked for, of the first effect [%]; NaN for a scene by levels, or a null."""
    found = re.fullmatch(r"([0-9.e+-]+) %", levels[0]) if levels else None
    return float(found[1]) if found else math.nan
