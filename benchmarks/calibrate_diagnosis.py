"""Calibrate the diagnosis on scenes whose effect is known: ``calibration.json`` of the package.

    python benchmarks/calibrate_diagnosis.py labels.json RUN [RUN ...] --source "what the scenes are" [--keep]
    python benchmarks/calibrate_diagnosis.py --left-out

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


def evidence_of(run: Path) -> dict[str, float]:
    """Log evidence of a run by effect, and for UNKNOWN, by the present weights."""
    with np.load(run / SCREENING_FILE) as stored:
        weights, usual_cost, left = Weights(), DiagnosisSettings().usual_cost, float(stored["left"])
        evidence = {}
        # From what was measured, so that runs with other weights serve as well.
        for name, hindsight, foretold, size in zip(
            stored["names"].tolist(), stored["hindsight"], stored["foretold"], stored["size"], strict=True
        ):
            moves = isinstance(CATALOGUE[name](), FORCES)
            gain = 0.0 if np.isnan(foretold) else float(foretold)
            moved = np.inf if np.isnan(size) else float(size)
            counted = weights.combined(float(hindsight), gain, moved)
            evidence[name] = tempered(counted, left, usual_cost) if moves else float(hindsight)
        evidence[UNKNOWN] = weights.combined(float(stored["unknown"]), 0.0)
    return evidence


def verdict_by(evidence: dict[str, float], calibration: Calibration) -> Verdict:
    """What a calibration makes of evidence; runs of any other one serve as well."""
    return verdict_of(
        probabilities(evidence, calibration),
        {name: value for name, value in evidence.items() if name != UNKNOWN},
        calibration,
        {},
    )


def read_case(run: Path, labels: dict[str, str]) -> Case:
    """One run with its label."""
    label = labels[run.name]
    truth = label if label in STAGES or label == NONE else UNKNOWN
    return Case(run.name, truth, evidence_of(run))


def write_cases(cases: list[Case], path: Path) -> None:
    """A table of scenes: name, truth, log evidence by effect."""
    rows = [{"scene": case.name, "truth": case.truth} | case.evidence for case in cases]
    write_text(path, pd.DataFrame(rows).round(3).to_csv(index=False))


def read_cases(path: Path) -> list[Case]:
    """The scenes of such a table."""
    table = pd.read_csv(path, keep_default_na=False, na_values=[""])
    known = [name for name in table.columns if name not in ("scene", "truth")]
    return [
        Case(row["scene"], row["truth"], {n: float(row[n]) for n in known if not np.isnan(row[n])})
        for _, row in table.iterrows()
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
        score = sum(np.log(probabilities(c.evidence, tried).get(c.truth, 0.0) + 1e-2) for c in cases)
        if best is None or score > best[0]:
            best = float(score), tried
    assert best is not None
    return best[1]


def left_out(cases: list[Case]) -> list[Verdict]:
    """The answer to every scene by a calibration from all the others."""
    return [
        verdict_by(case.evidence, calibrate([other for other in cases if other is not case], "the others"))
        for case in cases
    ]


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
    parser.add_argument(
        "--keep", action="store_true", help="what is usual; for too few scenes without effect"
    )
    parser.add_argument("--target", type=Path, default=TARGET)
    arguments = parser.parse_args()
    if not arguments.runs:
        cases = read_cases(SCENES)
    else:
        labels = json.loads(arguments.labels.read_text())
        cases = [read_case(run, labels) for run in arguments.runs if run.name in labels]
    if arguments.left_out:
        verdicts = left_out(cases)
        for case, verdict in zip(cases, verdicts, strict=True):
            print(f"{case.name:34s} {case.truth:22s} {verdict.effect:22s} {', '.join(verdict.candidates)}")
        print(summary(cases, verdicts))
        return
    if not arguments.source:
        parser.error("--source: say what the scenes are")
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
    write_cases(cases, SCENES)
    write_text(arguments.target, json.dumps(values, indent=1) + "\n")


if __name__ == "__main__":
    main()
