"""Calibrate the diagnosis on scenes whose effect is known: ``calibration.json`` of the package.

    python benchmarks/calibrate_diagnosis.py labels.json RUN [RUN ...] --source "what the scenes are" [--keep]
    python benchmarks/calibrate_diagnosis.py --left-out [--usual_cost inf] [--foresight 40] [--exact-steps]

``labels.json`` maps the name of a run's folder to its effect: a name of the catalogue, ``none``, or any other
name for what is outside. A run is the folder of one ``toile diagnose``. For each effect the scenes in which
nothing of its kind acts say what evidence is usual; threshold, temperature and the point of ``unknown`` then
make the known answers as probable as possible. The evidence of all scenes is kept in
``docs/results/calibration_scenes.csv``, which stands for the runs where none are given. Scenes used here are
no test of anything. ``--left-out`` writes nothing; it answers each scene with a calibration from all others,
the nearest thing to a test.
"""

from __future__ import annotations

import argparse
import itertools
import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from toile.atomic_file import write_text
from toile.diagnosis.decision import NONE, UNKNOWN, Calibration, Weights, probabilities, tempered
from toile.diagnosis.diagnose import SCREENING_FILE, DiagnosisSettings
from toile.diagnosis.effect_columns import FORCES
from toile.diagnosis.verdict import verdict_of
from toile.effects.base import Stage
from toile.effects.catalogue import CATALOGUE, MOVING, STAGES
from toile.evaluation.diagnosis_record import Verdict

KINDS = (MOVING, (Stage.CAMERA, Stage.OBSERVATION), (Stage.APPEARANCE,))
"""Stages whose effects leave the same sort of trace: in the motion, in the outline, in the colours."""
# Deviations of what is usual, at least: few scenes without effect show few of the ways to be misled.
_LEAST, _LEAST_MOVING = 1.0, 2.0
# ... and one of them that misleads is no rule: as many scenes of evidence zero and that deviation are taken
# for granted.
_GRANTED = 4
SCENES = Path(__file__).parent.parent / "docs/results/calibration_scenes.csv"
TARGET = Path(__file__).parent.parent / "src/toile/diagnosis/calibration.json"


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
    """What a run has measured, one row per effect and one for UNKNOWN: what evidence is made from."""
    with np.load(run / SCREENING_FILE) as stored:
        columns = {
            "effect": stored["names"].tolist(),
            "hindsight": stored["hindsight"],
            "foretold": stored["foretold"],
            "size": stored["size"],
        }
        unknown = {"effect": UNKNOWN, "hindsight": float(stored["unknown"])}
        table = pd.concat([pd.DataFrame(columns), pd.DataFrame([unknown])], ignore_index=True)
        step = float(stored["time_step_error"]) / float(stored["width"])
        return table.assign(left=float(stored["left"]), step=step)


def evidence_from(
    table: pd.DataFrame, weights: Weights | None = None, usual_cost: float | None = None
) -> dict[str, float]:
    """Log evidence by effect, and for UNKNOWN, from what was measured, whatever the run's own weights."""
    weights = weights or Weights()
    usual_cost = DiagnosisSettings().usual_cost if usual_cost is None else usual_cost
    evidence = {}
    for row in table.itertuples():
        name, gain = str(row.effect), 0.0 if np.isnan(row.foretold) else float(row.foretold)
        evidence[name] = float(row.hindsight)
        if name == UNKNOWN or isinstance(CATALOGUE[name](), FORCES):
            size = np.inf if np.isnan(row.size) else float(row.size)
            step = 0.0 if name == UNKNOWN else float(row.step)
            evidence[name] = weights.combined(float(row.hindsight), gain, size, step)
        if name != UNKNOWN and isinstance(CATALOGUE[name](), FORCES):
            evidence[name] = tempered(evidence[name], float(row.left), usual_cost)
    return evidence


def evidence_of(run: Path) -> dict[str, float]:
    """Log evidence of a run by effect, and for UNKNOWN."""
    return evidence_from(measured(run))


def verdict_by(evidence: dict[str, float], calibration: Calibration) -> Verdict:
    """What a calibration makes of evidence; runs of any other one serve as well."""
    return verdict_of(
        probabilities(evidence, calibration),
        {name: value for name, value in evidence.items() if name != UNKNOWN},
        calibration,
        {},
    )


def read_runs(runs: list[Path], labels: dict[str, str]) -> pd.DataFrame:
    """What labelled runs have measured, with their names and truths."""
    tables = []
    for run in runs:
        if run.name in labels:
            label = labels[run.name]
            truth = label if label in STAGES or label == NONE else UNKNOWN
            tables.append(measured(run).assign(scene=run.name, truth=truth))
    table = pd.concat(tables, ignore_index=True)
    return table[["scene", "truth", *table.columns.drop(["scene", "truth"])]]


def cases_of(
    table: pd.DataFrame, weights: Weights | None = None, usual_cost: float | None = None
) -> list[Case]:
    """The scenes of a table of read_runs."""
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


def calibrate(cases: list[Case], source: str, before: Calibration | None = None) -> Calibration:
    """Usual evidence from quiet scenes, or as it was before, the rest by the known answers' probability."""
    usual, spread = {}, {}
    for effect in STAGES:
        # What speaks against an effect does not make it harder to believe where something speaks for it.
        values = [max(c.evidence[effect], 0) for c in cases if effect in c.evidence and is_quiet(c, effect)]
        if len(values) >= 3:
            least = _LEAST_MOVING if STAGES[effect] in MOVING else _LEAST
            usual[effect], spread[effect] = _usual(values, least)
    quiet = [
        c.evidence[UNKNOWN] for c in cases if c.truth == NONE or STAGES.get(c.truth) not in (None, *MOVING)
    ]
    usual[UNKNOWN], spread[UNKNOWN] = _usual(quiet, _LEAST_MOVING)
    if before is not None:
        usual, spread = dict(before.usual), dict(before.spread)
    best: tuple[float, Calibration] | None = None
    for temperature, threshold, unknown in itertools.product(
        (0.5, 0.75, 1.0, 1.5), (1.5, 2.0, 2.5, 3.0, 4.0, 5.0), (1.5, 2.0, 3.0, 4.0, 5.0, 6.0)
    ):
        tried = Calibration(usual, spread, temperature, threshold, unknown, source)
        score = sum(_score(case, tried) for case in cases)
        if best is None or score > best[0]:
            best = float(score), tried
    assert best is not None
    return best[1]


def left_out(cases: list[Case]) -> tuple[list[Verdict], float]:
    """The answer to every scene by a calibration from all the others, and how probable the truths are."""
    verdicts, score = [], 0.0
    for case in cases:
        found = calibrate([other for other in cases if other is not case], "the others")
        verdicts.append(verdict_by(case.evidence, found))
        score += _score(case, found)
    return verdicts, score


def summary(cases: list[Case], verdicts: list[Verdict]) -> str:
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


def _score(case: Case, calibration: Calibration) -> float:
    """Log probability of the truth; one that is out of the question costs no more than a hundredth."""
    return float(np.log(probabilities(case.evidence, calibration).get(case.truth, 0.0) + 1e-2))


def _usual(values: list[float], least: float) -> tuple[float, float]:
    """Mean and deviation of evidence without its effect; the deviation is at least ``least``."""
    n = len(values) + _GRANTED
    mean = float(np.sum(values)) / n
    squares = float(np.sum((np.array(values) - mean) ** 2)) + _GRANTED * least**2
    return mean, max(least, float(np.sqrt(squares / (n - 1))))


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("labels", type=Path, nargs="?")
    parser.add_argument("runs", type=Path, nargs="*")
    parser.add_argument("--source", default="")
    parser.add_argument("--left-out", action="store_true", help="each scene answered without itself")
    for name, value in {**asdict(Weights()), "usual_cost": DiagnosisSettings().usual_cost}.items():
        parser.add_argument(f"--{name}", type=float, default=value, help="tried, with --left-out")
    parser.add_argument("--exact-steps", action="store_true", help="as if half the time step changed nothing")
    parser.add_argument(
        "--keep", action="store_true", help="what is usual; for too few scenes without effect"
    )
    parser.add_argument("--target", type=Path, default=TARGET)
    arguments = parser.parse_args()
    if not arguments.runs:
        table = pd.read_csv(SCENES, keep_default_na=False, na_values=[""])
    else:
        table = read_runs(arguments.runs, json.loads(arguments.labels.read_text()))
    if arguments.left_out:
        if arguments.exact_steps:
            table = table.assign(step=0.0)
        weights = Weights(**{name: getattr(arguments, name) for name in asdict(Weights())})
        cases = cases_of(table, weights, arguments.usual_cost)
        verdicts, score = left_out(cases)
        for case, verdict in zip(cases, verdicts, strict=True):
            print(f"{case.name:34s} {case.truth:22s} {verdict.effect:22s} {', '.join(verdict.candidates)}")
        print(f"{summary(cases, verdicts)}\nlog score {score:.1f}")
        return
    if not arguments.source:
        parser.error("--source: say what the scenes are")
    cases = cases_of(table)
    found = calibrate(cases, arguments.source, Calibration.load() if arguments.keep else None)
    right = 0
    for case in cases:
        chances = probabilities(case.evidence, found)
        first, chance = next(iter(chances.items()))
        right += first == case.truth
        truth = chances.get(case.truth, 0)
        print(f"{case.name:34s} {case.truth:22s} {first:22s} {chance:.2f} truth {truth:.2f}")
    print(f"{right} of {len(cases)} right on the scenes it was made from")
    values = {
        k: {n: round(v, 3) for n, v in d.items()} if isinstance(d, dict) else d
        for k, d in asdict(found).items()
    }
    write_text(SCENES, table.to_csv(index=False, float_format="%.6g"))
    write_text(arguments.target, json.dumps(values, indent=1) + "\n")


if __name__ == "__main__":
    main()
