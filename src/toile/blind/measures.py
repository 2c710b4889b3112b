"""Marks of a diagnosis: one row per scene, then the table of measures with intervals over scenes."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.stats import binomtest, bootstrap
from sklearn.metrics import average_precision_score, f1_score

from toile.blind.magnitudes import comparisons, coverage, relative_error
from toile.blind.sealing import Sealed
from toile.diagnosis.record import AMBIGUOUS, NONE, UNKNOWN, GapReport, Verdict
from toile.effects.catalogue import STAGES

Array = NDArray[np.float64]

CONFIDENT = 0.9
"""Probability from which a wrong answer counts as confident."""
FRAME_SCORE = 2.0
"""Score (Where.frames) from which a frame counts as one that the effect acts in."""


@dataclass(frozen=True)
class Statistic:
    """A number of some rows of the marks.

    Attributes:
        column: of the marks.
        over: a number of the values that are there, along an axis.
        worst_effect: whether it is the smallest mean over the scenes of one effect instead.
    """

    column: str
    over: Callable[..., Any] = np.mean
    worst_effect: bool = False

    def __call__(self, rows: pd.DataFrame) -> float:
        """The number; NaN where there is no value."""
        values, effects = self._sample(rows)
        return float(self._of(values, effects)) if len(values) else math.nan

    def count(self, rows: pd.DataFrame) -> int:
        """Number of rows that have a value."""
        return len(_column(rows, self.column))

    def behind(self, rows: pd.DataFrame) -> int:
        """Number of rows that its value is of: of the worst effect, the fewest where several are as bad."""
        if not self.worst_effect:
            return self.count(rows)
        values, effects = self._sample(rows)
        each = [values[effects == effect] for effect in np.unique(effects)]
        return min(len(one) for one in each if one.mean() == min(other.mean() for other in each))

    def interval(self, rows: pd.DataFrame, resamplings: int, rng: np.random.Generator) -> tuple[float, float]:
        """95 % interval by resampling the scenes that have a value."""
        sample = self._sample(rows)
        if len(sample[0]) < 2:
            return self(rows), self(rows)
        found = bootstrap(
            sample, self._of, n_resamples=resamplings, paired=True, method="percentile", rng=rng
        ).confidence_interval
        return float(found.low), float(found.high)

    def _sample(self, rows: pd.DataFrame) -> tuple[Array, Array]:
        """Values that are there (n,), and numbers that tell their effects apart (n,)."""
        values = _column(rows, self.column)
        return values.to_numpy(), pd.factorize(rows["truth"][values.index])[0].astype(np.float64)

    def _of(self, values: Array, effects: Array, axis: int = -1) -> Any:
        if not self.worst_effect:
            return self.over(values, axis=axis)
        inside = [effects == effect for effect in np.unique(effects)]
        # A resample may do without an effect, never without all of them.
        with np.errstate(invalid="ignore"):
            return np.fmin.reduce([(values * at).sum(axis) / at.sum(axis) for at in inside])


@dataclass(frozen=True)
class Measure:
    """One row of the table.

    Attributes:
        name: of the measure.
        aim: as a text, e.g. "≥ 0.97".
        select: rows of the marks that it is over.
        value: number of the selected rows; NaN where there is none.
        at_least: aim as a number, if it is a lower bound; at_most: if it is an upper one.
        naive: whether it can be said of the naive baseline.
        proportion: whether it is a share of scenes.
    """

    name: str
    aim: str
    select: Callable[[pd.DataFrame], pd.DataFrame]
    value: Statistic
    at_least: float | None = None
    at_most: float | None = None
    naive: bool = False
    proportion: bool = True

    def reached(self, value: float) -> str:
        """Whether the aim is reached: "yes", "no", or "–" where there is nothing to say."""
        if math.isnan(value):
            return "–"
        low, high = self.at_least, self.at_most
        return "yes" if (low is None or value >= low) and (high is None or value <= high) else "no"


def mark(
    name: str, sealed: Sealed, report: GapReport | None, folder: Path, *, alias: float
) -> dict[str, Any]:
    """Marks of one scene; a scene without a diagnosis is wrong in everything.

    Args:
        name: of the scene.
        sealed: its open label.
        report: the diagnosis, None if there is none.
        folder: of the diagnosis, which paths in it are relative to.
        alias: see Alias.classes.

    Returns:
        Cells by column; NaN (or None) where a mark does not apply.
    """
    label = sealed.label
    truth = truth_of(label)
    row: dict[str, Any] = {
        "scene": name,
        "generator": label.get("generator", "?"),
        "kind": kind_of(label),
        "truth": "+".join(truth),
        "level": "+".join(label.get("levels", [])),
        "true_stage": label["stage"],
        "gap_percent": float(label["magnitude"]["mean_last_third"]),
        "size": size_in_label(label),
    }
    if report is None:
        # Wrong in everything that is asked of it.
        wrong = dict.fromkeys(("stage_right", "top1", "set_right", "pair_right", "abstains"), False)
        return row | {"answer": "no diagnosis", **wrong, "false_alarm": True, "confidently_wrong": True}
    verdict = report.verdict
    row |= _marks(verdict, truth, label["stage_accept"])
    row["candidates"] = ", ".join(verdict.candidates)
    row["also"] = verdict.also or ""
    row["naive"] = report.protocol.naive
    naive = _naive_verdict(report.protocol.naive)
    row |= {f"naive_{k}": v for k, v in _marks(naive, truth, label["stage_accept"]).items()}
    if row["kind"] == "single":
        row["identifiable"] = _is_identifiable(report, truth[0], alias)
        row |= magnitude(report, sealed, truth[0])
        row |= shrink_marks(report, verdict, truth[0])
        row["detection_limit"] = report.alias.detection_limits.get(truth[0])
    row |= localisation(report, sealed, folder)
    return row


def measures() -> tuple[Measure, ...]:
    """The table's rows, with the aims of the project."""

    def kinds(*names: str) -> Callable[[pd.DataFrame], pd.DataFrame]:
        return lambda marks: marks[marks["kind"].isin(names)]

    def clear(marks: pd.DataFrame) -> pd.DataFrame:
        return marks[(marks["kind"] == "single") & (marks["identifiable"] != False)]  # noqa: E712

    def unclear(marks: pd.DataFrame) -> pd.DataFrame:
        return marks[(marks["kind"] == "single") & (marks["identifiable"] == False)]  # noqa: E712

    def mean(column: str) -> Statistic:
        return Statistic(column)

    def median(column: str) -> Statistic:
        return Statistic(column, np.median)

    single = kinds("single")
    return (
        Measure("stage accuracy", "≥ 0.97", kinds("single", "null"), mean("stage_right"), 0.97, naive=True),
        Measure("top-1 effect, identifiable singles", "≥ 0.90", clear, mean("top1"), 0.90, naive=True),
        Measure(
            "top-1, worst effect",
            "≥ 0.70",
            clear,
            Statistic("top1", worst_effect=True),
            0.70,
            naive=True,
        ),
        Measure("90 % set: coverage", "≥ 0.90", kinds("single", "null"), mean("set_right"), 0.90),
        Measure(
            "90 % set: mean size",
            "≤ 1.5",
            kinds("single", "null"),
            mean("set_size"),
            at_most=1.5,
            proportion=False,
        ),
        Measure(
            "false alarms on nulls", "≤ 0.02", kinds("null"), mean("false_alarm"), at_most=0.02, naive=True
        ),
        Measure("outside: abstains", "≥ 0.85", kinds("outside"), mean("abstains"), 0.85, naive=True),
        Measure(
            "outside: confidently wrong",
            "≤ 0.05",
            kinds("outside"),
            mean("confidently_wrong"),
            at_most=0.05,
            naive=True,
        ),
        Measure(
            "pairs: one right, none wrong", "≥ 0.90", kinds("pair"), mean("pair_right"), 0.90, naive=True
        ),
        Measure("unidentifiable called ambiguous", "≥ 0.90", unclear, mean("called_ambiguous"), 0.90),
        Measure(
            "magnitude: median error",
            "≤ 0.15",
            single,
            median("magnitude_error"),
            at_most=0.15,
            proportion=False,
        ),
        Measure(
            "magnitude: 90 % interval coverage", "0.85–0.95", single, mean("magnitude_covered"), 0.85, 0.95
        ),
        Measure(
            "localisation: vertices AUPRC",
            "≥ 0.80",
            lambda marks: marks,
            mean("vertices_auprc"),
            0.80,
            proportion=False,
        ),
        Measure(
            "localisation: interval F1",
            "≥ 0.80",
            lambda marks: marks,
            mean("frames_f1"),
            0.80,
            proportion=False,
        ),
        Measure("scenes improved", "≥ 0.95", single, mean("improved"), 0.95),
        Measure(
            "best placebo's shrink, median",
            "≤ 0.15",
            single,
            median("placebo_of_true"),
            at_most=0.15,
            proportion=False,
        ),
    )


def measured(marks: pd.DataFrame, *, resamplings: int, seed: int) -> pd.DataFrame:
    """The table: measure, aim, value, 95 % interval over scenes, scenes that count in it, aim reached, naive.

    Args:
        marks: one row per scene, see mark.
        resamplings: of scenes. Where every scene of a proportion is right, or every one wrong, resampling
            knows no spread; Wilson's interval takes its place.
        seed: of the resamplings.
    """
    rng = np.random.default_rng(seed)
    naive = naive_marks(marks)
    rows = []
    for measure in measures():
        chosen = measure.select(marks)
        value = measure.value(chosen)
        low, high = _interval(measure, chosen, value, resamplings, rng)
        other = measure.value(measure.select(naive)) if measure.naive else math.nan
        rows.append(
            {
                "measure": measure.name,
                "aim": measure.aim,
                "value": value,
                "low": low,
                "high": high,
                "scenes": measure.value.count(chosen),
                "reached": measure.reached(value),
                "naive": other,
            }
        )
    return pd.DataFrame(rows)


def naive_marks(marks: pd.DataFrame) -> pd.DataFrame:
    """The same rows with the marks of the naive baseline in the place of the diagnosis' own."""
    columns = [c for c in marks.columns if c.startswith("naive_")]
    renamed = marks[columns].rename(columns=lambda c: c.removeprefix("naive_"))
    kept = marks[[c for c in marks.columns if c not in set(renamed.columns) | set(columns)]]
    return pd.concat((kept, renamed), axis=1)


def confusion(marks: pd.DataFrame) -> pd.DataFrame:
    """Number of scenes by truth (rows) and answer (columns); pairs are left out."""
    rows = marks[marks["kind"] != "pair"]
    table: pd.DataFrame = pd.crosstab(rows["truth"], rows["answer"])
    return table


def detection(marks: pd.DataFrame) -> pd.DataFrame:
    """Per effect: sizes at which it was found and missed, in what its strength is named in.

    Columns: scenes, found, smallest_found, largest_missed, predicted (median of the diagnosis' own detection
    limits, in the unit of the effect's first parameter).
    """
    rows = []
    for name, group in marks[marks["kind"] == "single"].groupby("truth"):
        right = group["top1"].astype(bool)
        rows.append(
            {
                "effect": name,
                "scenes": len(group),
                "found": int(right.sum()),
                "smallest_found": group["size"][right].min() if right.any() else math.nan,
                "largest_missed": group["size"][~right].max() if (~right).any() else math.nan,
                "predicted": _column(group, "detection_limit").median(),
            }
        )
    columns = ["effect", "scenes", "found", "smallest_found", "largest_missed", "predicted"]
    return pd.DataFrame(rows, columns=columns)


def truth_of(label: Mapping[str, Any]) -> tuple[str, ...]:
    """Effects of a label; NONE where there is none."""
    names = label.get("effects")
    if names is None:
        names = [] if label["effect"] == NONE else [label["effect"]]
    return tuple(names) or (NONE,)


def kind_of(label: Mapping[str, Any]) -> str:
    """Whether a label is one of a "null", "outside" the catalogue, a "single" effect or a "pair"."""
    truth = truth_of(label)
    if truth == (NONE,):
        return "null"
    if not label["in_catalogue"]:
        return "outside"
    return "single" if len(truth) == 1 else "pair"


def size_in_label(label: Mapping[str, Any]) -> float:
    """Of a single effect, in what its strength is named in, NaN where it is not; the gap otherwise."""
    alone = label["magnitude"].get("alone", {})
    truth = truth_of(label)
    if kind_of(label) == "single":
        return float(alone.get(truth[0], {}).get("value", math.nan))
    return float(label["magnitude"]["mean_last_third"])


def _marks(verdict: Verdict, truth: tuple[str, ...], stages: Sequence[str]) -> dict[str, Any]:
    """What is right and wrong in an answer, whichever kind of scene it is about."""
    named = tuple(n for n in (verdict.effect, verdict.also) if n and n not in (NONE, AMBIGUOUS, UNKNOWN))
    abstains = verdict.effect in (AMBIGUOUS, UNKNOWN)
    doubts = verdict.effect == AMBIGUOUS and NONE in verdict.candidates
    return {
        "answer": verdict.effect,
        "probability": verdict.probability,
        "stage_right": verdict.stage in stages,
        "top1": verdict.effect == truth[0],
        "set_right": truth[0] in verdict.candidates,
        "set_size": float(len(verdict.candidates)),
        "false_alarm": verdict.effect != NONE and not doubts,
        "abstains": abstains,
        "confidently_wrong": bool(named)
        and not set(named) <= set(truth)
        and verdict.probability >= CONFIDENT,
        "pair_right": bool(set(named) & set(truth)) and set(named) <= set(truth),
        "called_ambiguous": verdict.effect == AMBIGUOUS and truth[0] in verdict.candidates,
    }


def _naive_verdict(name: str) -> Verdict:
    """The baseline always names the candidate that fits best, and is sure of it."""
    return Verdict(name, (name,), STAGES[name].value if name in STAGES else "", 1.0, "", "")


def _is_identifiable(report: GapReport, truth: str, alias: float) -> bool:
    """Whether no other effect or base parameter leaves the same trace on this clip."""
    names = tuple(name.partition(".")[0] for name in report.alias.names)
    plain = replace(report.alias, names=names)
    return all(set(group) == {truth} for group in plain.classes(alias) if truth in group)


def magnitude(report: GapReport, sealed: Sealed, truth: str) -> dict[str, Any]:
    """Relative error and coverage of the true effect's magnitude, where both sides have one."""
    effect = report.effect(truth)
    if effect is None:
        return {}
    found = comparisons(effect, sealed)
    if not found:
        return {}
    cells = [
        f"{c.name}: {c.truth:.3g}{'' if c.unit == '1' else f' {c.unit}'}, "
        f"{c.estimate:.3g} [{c.low:.3g}, {c.high:.3g}]"
        for c in found
    ]
    return {
        "magnitude": "; ".join(cells),
        "magnitude_error": relative_error(found),
        "magnitude_covered": coverage(found),
    }


def shrink_marks(report: GapReport, verdict: Verdict, truth: str) -> dict[str, Any]:
    """Held-out error with the answer, the true effect, the runner-up and the best placebo.

    The runner-up is the best wrong candidate. The true effect, fitted by the same fitter, is the oracle;
    where it was not among those compared, only what stands beside it is known.
    """
    compared = [e for e in report.effects if e.shrink is not None]
    marks: dict[str, Any] = {}
    others = {e.name: e.shrink.estimate for e in compared if e.shrink is not None and e.name != truth}
    if others:
        marks["runner_up"] = max(others, key=lambda name: others[name])
        marks["shrink_runner_up"] = others[marks["runner_up"]]
    placebos = [
        e.shrink.best_placebo for e in compared if e.shrink is not None and e.shrink.best_placebo is not None
    ]
    if placebos:
        marks["shrink_placebo"] = max(placebos)
    true = report.effect(truth)
    if true is None or true.shrink is None:
        return marks
    base, saved = true.shrink.base, true.shrink.base - true.shrink.with_effect
    marks["shrink_true"] = true.shrink.estimate
    # Where the true effect does not help, no share of that help means anything.
    if saved > 1e-3 * base:
        answered = report.effect(verdict.effect)
        helped = 0.0 if answered is None or answered.shrink is None else answered.shrink.estimate
        marks["improved"] = helped > 0
        marks["share_of_oracle"] = helped * base / saved
        if placebos:
            marks["placebo_of_true"] = max(placebos) * base / saved
    return marks


_ACTS_ON = 2
"""Format of Blender's labels from which on they name the vertices that an effect acts on."""


def localisation(report: GapReport, sealed: Sealed, folder: Path) -> dict[str, Any]:
    """Marks of where and when, for effects that do not act everywhere and always."""
    marks: dict[str, Any] = {}
    where = sealed.label.get("localisation", {})
    vertices, frames = where.get("vertices"), where.get("frames")
    if sealed.label.get("engine") == "blender" and sealed.label.get("format", 1) < _ACTS_ON:
        # Which vertices move says nothing of where the cause is.
        vertices = None
    # Where the effect that is named acts; of others what the base model is wrong by.
    path = report.where.acts_on or report.where.vertices
    if vertices and path is not None and (folder / path).is_file():
        # The label counts on the scene's grid, the score is on that of the diagnosis' model.
        score = _on_grid(np.load(folder / path).astype(np.float64), sealed.vertices.shape[1:3]).ravel()
        if max(vertices) < len(score):
            truth = np.zeros(len(score), bool)
            truth[vertices] = True
            # Where the effect acts everywhere, any score would do.
            if not truth.all():
                marks["vertices_auprc"] = float(average_precision_score(truth, np.nan_to_num(score)))
    scores = np.array(report.where.frames)
    if frames and max(frames) < len(scores) and len(frames) < len(scores):
        truth = np.zeros(len(scores), bool)
        truth[frames] = True
        marks["frames_f1"] = float(f1_score(truth, scores >= FRAME_SCORE))
    return marks


def _on_grid(score: Array, grid: tuple[int, ...]) -> Array:
    """Scores (h, w) at the vertices of another grid over the same cloth, linearly interpolated."""
    if score.shape == grid:
        return score
    at = [np.linspace(0, n - 1, m) for n, m in zip(score.shape, grid, strict=True)]
    found: Array = map_coordinates(score, np.stack(np.meshgrid(*at, indexing="ij")), order=1)
    return found


def _interval(
    measure: Measure, rows: pd.DataFrame, value: float, resamplings: int, rng: np.random.Generator
) -> tuple[float, float]:
    """95 % interval over scenes."""
    low, high = measure.value.interval(rows, resamplings, rng)
    if measure.proportion and low == high and value in (0.0, 1.0):
        n = measure.value.behind(rows)
        found = binomtest(round(value * n), n).proportion_ci(method="wilson")
        return float(found.low), float(found.high)
    return low, high


def _column(rows: pd.DataFrame, name: str) -> pd.Series:
    """Numbers of a column without the missing ones."""
    if name not in rows.columns:
        return pd.Series(dtype=np.float64)
    return rows[name].dropna().astype(np.float64)
