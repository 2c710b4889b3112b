"""A calibration from scenes whose effect is known: usual evidence, and what makes probabilities of it.

For each effect the scenes in which nothing of its kind acts say what evidence is usual; threshold,
temperature and the point of UNKNOWN then make the known answers as probable as possible. Scenes used here
are no test of anything; ``left_out`` answers each scene with a calibration from all others, the nearest
thing to a test.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pydantic import Field
from scipy.optimize import brute

from toile.atomic_file import write_text
from toile.diagnosis.arrays import SCREENING_FILE
from toile.diagnosis.decision import NONE, UNKNOWN, Calibration, Weights, probabilities, tempered
from toile.diagnosis.effect_sensitivities import FORCES
from toile.diagnosis.made_with import MADE_WITH_FILE, MadeWith
from toile.diagnosis.record import Verdict
from toile.diagnosis.verdict import DEFAULT as VERDICT
from toile.diagnosis.verdict import VerdictSettings, verdict_of
from toile.effects.base import Stage
from toile.effects.catalogue import CATALOGUE, MOVING, STAGES
from toile.errors import InputError
from toile.former_names import EVIDENCE_COLUMNS, renamed
from toile.limits import Count, Finite, NonNegative, Positive

KINDS = (MOVING, (Stage.CAMERA, Stage.OBSERVATION), (Stage.APPEARANCE,))
"""Stages whose effects leave the same sort of trace: in the motion, in the outline, in the brightness."""

_MEASURED = ("scene", "truth", "effect", "in_sample", "prediction_gain", "size", "left", "step")
_SETTINGS = "settings"


@dataclass(frozen=True)
class CalibrationSettings:
    """How a calibration is made of scenes.

    Attributes:
        temperatures: that are tried; the best of all combinations counts.
        thresholds: of effects that are tried, in deviations.
        unknowns: points of UNKNOWN that are tried, in deviations.
        least: deviation of what is usual at least, as few scenes without effect show few of the ways to be
            misled.
        least_moving: the same of effects that move the cloth, and of UNKNOWN.
        granted: scenes of evidence zero and that deviation which are taken for granted beside those there
            are: one scene that misleads is no rule.
        fewest: scenes without effect that say what is usual; with fewer, nothing is.
        floor: probability that a truth which is out of the question costs no less than.
    """

    temperatures: Annotated[tuple[Positive, ...], Field(min_length=1)] = (0.5, 0.75, 1.0, 1.5)
    thresholds: Annotated[tuple[Finite, ...], Field(min_length=1)] = (1.5, 2.0, 2.5, 3.0, 4.0, 5.0)
    unknowns: Annotated[tuple[Finite, ...], Field(min_length=1)] = (1.5, 2.0, 3.0, 4.0, 5.0, 6.0)
    least: Positive = 1.0
    least_moving: Positive = 2.0
    granted: NonNegative = 4.0
    fewest: Count = 3
    floor: Positive = 1e-2


DEFAULT = CalibrationSettings()


@dataclass(frozen=True)
class Case:
    """One diagnosed scene.

    Attributes:
        name: of the run's folder.
        truth: catalogue name, NONE or UNKNOWN.
        evidence: by effect, and for UNKNOWN.
    """

    name: str
    truth: str
    evidence: dict[str, float]


def measured(run: Path) -> pd.DataFrame:
    """What a run has measured, one row per effect and one for UNKNOWN: what evidence is made from.

    Raises:
        InputError: the folder has no such measurements.
    """
    try:
        with np.load(run / SCREENING_FILE) as file:
            stored = renamed(file, EVIDENCE_COLUMNS)
            columns = {
                "effect": stored["names"].tolist(),
                "in_sample": stored["in_sample"],
                "prediction_gain": stored["prediction_gain"],
                "size": stored["size"],
            }
            unknown = {"effect": UNKNOWN, "in_sample": float(stored["unknown"])}
            table = pd.concat([pd.DataFrame(columns), pd.DataFrame([unknown])], ignore_index=True)
            step = float(stored["time_step_error"]) / float(stored["width"])
            return table.assign(left=float(stored["left"]), step=step)
    except (OSError, ValueError, KeyError) as error:
        raise InputError(
            "A run has no measured evidence",
            where=str(run / SCREENING_FILE),
            expected="the folder of a finished toile diagnose",
            got=f"{type(error).__name__}: {error}",
        ) from error


def evidence_from(table: pd.DataFrame, weights: Weights, usual_cost: float) -> dict[str, float]:
    """Log evidence by effect, and for UNKNOWN, from what was measured, whatever the run's own weights.

    Args:
        table: of ``measured``.
        weights: what it counts for.
        usual_cost: of the images that a right model leaves, per fitted frame.
    """
    evidence = {}
    for row in table.itertuples():
        name, gain = str(row.effect), 0.0 if np.isnan(row.prediction_gain) else float(row.prediction_gain)
        evidence[name] = float(row.in_sample)
        if name == UNKNOWN or isinstance(CATALOGUE[name](), FORCES):
            size = np.inf if np.isnan(row.size) else float(row.size)
            step = 0.0 if name == UNKNOWN else float(row.step)
            evidence[name] = weights.combined(float(row.in_sample), gain, size, step)
        if name != UNKNOWN and isinstance(CATALOGUE[name](), FORCES):
            evidence[name] = tempered(evidence[name], float(row.left), usual_cost)
    return evidence


def evidence_of(run: Path, weights: Weights, usual_cost: float) -> dict[str, float]:
    """Log evidence of a run by effect, and for UNKNOWN; see evidence_from."""
    return evidence_from(measured(run), weights, usual_cost)


def verdict_by(
    evidence: Mapping[str, float], calibration: Calibration, settings: VerdictSettings = VERDICT
) -> Verdict:
    """What a calibration makes of evidence; runs of any other one serve as well."""
    return verdict_of(
        probabilities(evidence, calibration),
        {name: value for name, value in evidence.items() if name != UNKNOWN},
        calibration,
        {},
        settings=settings,
    )


def read_labels(path: Path) -> dict[str, str]:
    """Effect by name of a run's folder: a name of the catalogue, NONE, or any other for what is outside.

    Raises:
        InputError: the file is not there, or holds something else.
    """
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(values, dict) or not all(isinstance(v, str) for v in values.values()):
            raise TypeError("no object of texts")
    except (OSError, ValueError, TypeError) as error:
        raise InputError(
            "Labels cannot be read",
            where=str(path),
            expected='JSON such as {"<name of a run folder>": "air_drag", "<another>": "none"}',
            got=f"{type(error).__name__}: {error}",
        ) from error
    return values


def read_runs(runs: Sequence[Path], labels: Mapping[str, str], made_with: MadeWith) -> pd.DataFrame:
    """What labelled runs have measured, with their names and truths, all with the same settings.

    Args:
        runs: folders of ``toile diagnose``.
        labels: see read_labels.
        made_with: settings that they must have been diagnosed with; what they count for may differ.

    Raises:
        InputError: a run has no label, has not measured, or was made with other settings.
    """
    tables = []
    wanted = made_with.measuring
    for run in runs:
        name = run.resolve().name
        if name not in labels:
            raise InputError(
                "A run has no label",
                where=str(run),
                expected="its name in labels=<file>",
                got=f"labels of {', '.join(list(labels)[:5]) or 'nothing'}",
            )
        found = MadeWith.read(run / MADE_WITH_FILE).measuring
        differences = found.differences(wanted, "asked for: ")
        if differences:
            raise InputError(
                "A run was diagnosed with other settings than the calibration is for",
                where=str(run),
                expected="the same; give toile calibrate the overrides that the diagnoses had",
                got="; ".join(differences),
            )
        label = labels[name]
        truth = label if label in STAGES or label == NONE else UNKNOWN
        tables.append(measured(run).assign(scene=name, truth=truth))
    table = pd.concat(tables, ignore_index=True).assign(**{_SETTINGS: wanted.digest})
    return table[[*_MEASURED, _SETTINGS]]


def write_table(path: Path, table: pd.DataFrame) -> Path:
    """Write what scenes have measured as CSV, atomically; returns the path."""
    return write_text(path, table.to_csv(index=False, float_format="%.6g"))


def read_table(path: Path, made_with: MadeWith) -> pd.DataFrame:
    """What ``write_table`` has written; a table without a column of settings is taken at its word.

    Raises:
        InputError: there is no such table, or it was measured with other settings.
    """
    try:
        # A name or a digest may look like a number.
        texts = dict.fromkeys((*_MEASURED[:3], _SETTINGS), str)
        numbers = dict.fromkeys((*_MEASURED[3:], *EVIDENCE_COLUMNS), float)
        table = pd.read_csv(path, keep_default_na=False, na_values=[""], dtype={**texts, **numbers})
        table = table.rename(columns=EVIDENCE_COLUMNS)
        missing = [column for column in _MEASURED if column not in table]
        if missing:
            raise ValueError(f"no column {', '.join(missing)}")
        strange = sorted({*table["effect"]} - {*CATALOGUE, UNKNOWN})
        if strange or table.empty:
            raise ValueError(f"unknown effects {', '.join(map(str, strange))}" if strange else "no scenes")
    except (OSError, ValueError) as error:
        raise InputError(
            "No measured scenes can be read",
            where=str(path),
            expected=f"a CSV of toile calibrate, columns {', '.join(_MEASURED)}",
            got=f"{type(error).__name__}: {error}",
        ) from error
    wanted = made_with.measuring.digest
    if _SETTINGS in table and set(table[_SETTINGS].astype(str)) != {wanted}:
        raise InputError(
            "The scenes were measured with other settings than the calibration is for",
            where=str(path),
            expected=f"settings {wanted}; give toile calibrate the overrides that the diagnoses had",
            got=f"settings {', '.join(sorted(set(table[_SETTINGS].astype(str))))}",
        )
    return table


def cases_of(table: pd.DataFrame, weights: Weights, usual_cost: float) -> list[Case]:
    """The scenes of a table of read_runs or read_table; see evidence_from."""
    return [
        Case(str(scene), str(rows["truth"].iloc[0]), evidence_from(rows, weights, usual_cost))
        for scene, rows in table.groupby("scene", sort=False)
    ]


def is_quiet(case: Case, effect: str) -> bool:
    """Whether nothing acts in the scene that the effect could be mistaken for."""
    if case.truth == NONE:
        return True
    if case.truth == UNKNOWN:
        return False
    kind = next(kind for kind in KINDS if STAGES[effect] in kind)
    return STAGES[case.truth] not in kind


def calibrate(
    cases: Sequence[Case],
    source: str,
    before: Calibration | None = None,
    settings: CalibrationSettings = DEFAULT,
    made_with: MadeWith | None = None,
) -> Calibration:
    """Usual evidence from quiet scenes, or as it was before, the rest by the known answers' probability.

    Args:
        cases: scenes.
        source: what they are.
        before: gives what is usual, where too few scenes have no effect; None to find it.
        settings: see CalibrationSettings.
        made_with: settings of the diagnoses, which the calibration belongs to.

    Raises:
        InputError: no scene says what is usual for UNKNOWN.
    """
    usual, spread = {}, {}
    for effect in STAGES:
        # What speaks against an effect does not make it harder to believe where something speaks for it.
        values = [max(c.evidence[effect], 0) for c in cases if effect in c.evidence and is_quiet(c, effect)]
        if len(values) >= settings.fewest:
            least = settings.least_moving if STAGES[effect] in MOVING else settings.least
            usual[effect], spread[effect] = _usual(values, least, settings.granted)
    if before is None:
        quiet = [
            c.evidence[UNKNOWN]
            for c in cases
            if c.truth == NONE or STAGES.get(c.truth) not in (None, *MOVING)
        ]
        if not quiet:
            raise InputError(
                "No scene says what is usual",
                where="toile calibrate",
                expected="scenes without an effect on the motion, or usual_from=<calibration>",
                got=f"{len(cases)} scenes, each with one",
            )
        usual[UNKNOWN], spread[UNKNOWN] = _usual(quiet, settings.least_moving, settings.granted)
    else:
        usual, spread = dict(before.usual), dict(before.spread)
    tried = (settings.temperatures, settings.thresholds, settings.unknowns)

    def made(at: NDArray[np.integer]) -> Calibration:
        temperature, threshold, unknown = (values[int(i)] for values, i in zip(tried, at, strict=True))
        return Calibration(usual, spread, temperature, threshold, unknown, source, made_with)

    def loss(at: NDArray[np.integer]) -> float:
        found = made(at)
        return -sum(_score(case, found, settings.floor) for case in cases)

    # All of so few: between them the scenes do not choose.
    best = brute(loss, tuple(slice(0, len(values), 1) for values in tried), finish=None)
    return made(np.atleast_1d(best))


def left_out(
    cases: Sequence[Case],
    before: Calibration | None = None,
    settings: CalibrationSettings = DEFAULT,
    verdict: VerdictSettings = VERDICT,
) -> tuple[list[Verdict], float]:
    """The answer to every scene by a calibration from all the others, and the truths' log probability.

    Args:
        cases: scenes.
        before: see calibrate.
        settings: see CalibrationSettings.
        verdict: when an answer is given.
    """
    verdicts, score = [], 0.0
    for case in cases:
        found = calibrate([other for other in cases if other is not case], "the others", before, settings)
        verdicts.append(verdict_by(case.evidence, found, verdict))
        score += _score(case, found, settings.floor)
    return verdicts, score


def summary(cases: Sequence[Case], verdicts: Sequence[Verdict]) -> str:
    """How many answers are right, by kind of truth."""
    kinds: dict[str, list[tuple[str, Verdict]]] = {"none": [], "image": [], "motion": [], "outside": []}
    for case, verdict in zip(cases, verdicts, strict=True):
        kind = {NONE: "none", UNKNOWN: "outside"}.get(case.truth)
        if kind is None:
            kind = "motion" if STAGES[case.truth] in MOVING else "image"
        kinds[kind].append((case.truth, verdict))
    lines = []
    for kind, found in kinds.items():
        right = sum(verdict.effect == truth for truth, verdict in found)
        held = sum(truth in verdict.candidates for truth, verdict in found)
        size = sum(len(verdict.candidates) for _, verdict in found) / max(len(found), 1)
        wrong = sum(verdict.effect in STAGES and verdict.effect != truth for truth, verdict in found)
        lines.append(
            f"{kind}: {right} of {len(found)} right, {held} in the 90 % set of {size:.1f} on average, "
            f"{wrong} named wrongly"
        )
    return "\n".join(lines)


def _score(case: Case, calibration: Calibration, floor: float) -> float:
    """Log probability of the truth."""
    return float(np.log(probabilities(case.evidence, calibration).get(case.truth, 0.0) + floor))


def _usual(values: Sequence[float], least: float, granted: float) -> tuple[float, float]:
    """Mean and deviation of evidence without its effect; the deviation is at least ``least``."""
    n = len(values) + granted
    mean = float(np.sum(values)) / n
    squares = float(np.sum((np.array(values) - mean) ** 2)) + granted * least**2
    return mean, max(least, float(np.sqrt(squares / (n - 1))))
