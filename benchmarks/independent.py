"""Diagnose the scenes of the independent engine: ``docs/results/independent.md`` and ``.csv``.

    make independent  # as single clips
    make independent-sessions  # each as a session of one clip, by the method of sessions, and R1 beside them

Labels are read for the table alone, after all answers are there, and only where they are open; those of the
withheld scenes are nowhere to be read. What is done is kept in ``outputs/independent`` and
``outputs/independent_sessions``.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import toile.cli  # noqa: F401  # isort: skip  # first, because it sets the number of threads

import numpy as np
import pandas as pd

from toile.atomic_file import write_text
from toile.blind.calibration import evidence_from, measured
from toile.cli.diagnose import diagnose_scene, diagnose_session_folder
from toile.diagnosis.arrays import SCREENING_FILE
from toile.diagnosis.decision import UNKNOWN, Calibration, probabilities
from toile.diagnosis.gap_maps import stage_shares
from toile.diagnosis.made_with import MADE_WITH_FILE, MadeWith
from toile.diagnosis.record import DIAGNOSIS_FILE, GapReport
from toile.diagnosis.session_weights import EVIDENCE_FILE, MotionEvidence
from toile.diagnosis.settings import DiagnosisSettings
from toile.diagnosis.verdict import verdict_of
from toile.scenes.native import write_native
from toile.scenes.registry import load_scene
from toile.scenes.session import SESSION_FILE

OUTPUT = Path("outputs/independent")
SESSIONS = Path("outputs/independent_sessions")
RESULTS = Path("docs/results")


def scenes(data: Path) -> list[Path]:
    """Folders of the scenes, labelled ones first."""
    return [p for part in ("labelled", "withheld") for p in sorted((data / part).iterdir()) if p.is_dir()]


def decided(run: Path) -> GapReport:
    """The report of a run, with what the committed calibration makes of its measured evidence.

    A run is made with the calibration of its day, and runs of labelled scenes have made later ones.
    """
    report, calibration, settings = (
        GapReport.read(run / DIAGNOSIS_FILE),
        Calibration.load(),
        DiagnosisSettings(),
    )
    table, made_with = measured(run), run / MADE_WITH_FILE
    evidence = evidence_from(table, settings.weights, settings.usual_cost)
    chances = probabilities(evidence, calibration)
    effects = {name: value for name, value in evidence.items() if name != UNKNOWN}
    explained = float(table["left"].iloc[0]) <= settings.usual_cost
    shrinks = {effect.name: effect.shrink for effect in report.effects if effect.shrink is not None}
    found = [replace(effect, probability=chances[effect.name]) for effect in report.effects]
    return replace(
        report,
        verdict=verdict_of(chances, effects, calibration, shrinks, explained=explained),
        where=replace(
            report.where, stages=stage_shares(effects, calibration, report.where.stages["numerics"])
        ),
        effects=tuple(sorted(found, key=lambda effect: -effect.probability)),
        # Runs of before do not say what they were made with.
        calibration=calibration.use(MadeWith.read(made_with) if made_with.is_file() else None),
    )


def row(scene: Path) -> dict[str, str]:
    """One line of the table."""
    run = OUTPUT / scene.name
    if not (run / DIAGNOSIS_FILE).is_file():
        return {"scene": scene.name, "label": _label(scene), "answer": "not run"}
    report = decided(run)
    verdict = report.verdict
    first = report.effect(verdict.effect)
    shrink = first.shrink if first is not None else None
    return {
        "scene": scene.name,
        "label": _label(scene),
        "answer": verdict.effect,
        "candidates": ", ".join(verdict.candidates),
        "stage": verdict.stage,
        "probability": f"{verdict.probability:.2f}",
        "naive": report.protocol.naive,
        "in_sample": _in_sample(run),
        "held-out error [mm]": "" if shrink is None else f"{shrink.base:.1f} -> {shrink.with_effect:.1f}",
    }


def _in_sample(run: Path) -> str:
    """The two effects with the largest log evidence from the fitted frames."""
    with np.load(run / SCREENING_FILE) as stored:
        found = zip(stored["in_sample"].tolist(), stored["names"].tolist(), strict=True)
        best = sorted(found, reverse=True)[:2]
    return ", ".join(f"{name} {value:.0f}" for value, name in best)


def _label(scene: Path) -> str:
    path = scene / "label.json"
    if scene.name == "R1":
        return "real"
    return json.loads(path.read_text())["effect"] if path.is_file() else "withheld"


def _missing(found: Sequence[Path], within: Path) -> Iterator[Path]:
    """Scenes without an answer, each named when its turn has come."""
    for scene in found:
        if not (within / scene.name / DIAGNOSIS_FILE).is_file():
            print(scene.name, flush=True)
            yield scene


def _withheld(found: Sequence[Path], within: Path) -> list[Path]:
    """Folders of the answers to scenes whose label is not known."""
    runs = [within / scene.name for scene in found if not (scene / "label.json").is_file()]
    return [run for run in runs if (run / DIAGNOSIS_FILE).is_file()]


def real(data: Path) -> Path:
    """The folder of R1 in the native layout, without what the depth camera saw."""
    folder = SESSIONS / "scenes" / "R1"
    if not folder.is_dir():
        folder.parent.mkdir(parents=True, exist_ok=True)
        write_native(replace(load_scene("R1", data), ground_truth=None), folder)
    return folder


def as_session(scene: Path, folder: Path) -> Path:
    """The folder of a session with this scene as its only clip; its corners were moved by hand."""
    folder.mkdir(parents=True, exist_ok=True)
    clip = {"scene": str(scene.resolve()), "motion": "shake"}
    write_text(folder / SESSION_FILE, json.dumps({"name": scene.name, "clips": [clip]}) + "\n")
    return folder


def session_row(scene: Path) -> dict[str, str]:
    """One line of the table of sessions of one clip."""
    run = SESSIONS / scene.name
    if not (run / DIAGNOSIS_FILE).is_file():
        return {"scene": scene.name, "label": _label(scene), "answer": "not run"}
    report, evidence = GapReport.read(run / DIAGNOSIS_FILE), MotionEvidence.load(run / EVIDENCE_FILE)
    verdict = report.verdict
    effect = report.effect(verdict.effect)
    shrink = effect.shrink if effect is not None else None
    usual = ", ".join(f"{name} {100 * size:.1f} %" for name, size in evidence.usual.items())
    return {
        "scene": scene.name,
        "label": _label(scene),
        "answer": verdict.effect,
        "candidates": ", ".join(verdict.candidates),
        "probability": f"{verdict.probability:.2f}",
        "largest drop": report.protocol.naive,
        "under a law [nats]": _two({name: evidence.nats(name) for name in evidence.effects}),
        "from outside [nats]": _two({name: one.nats() for name, one in evidence.outside.items()}),
        "usual effects move it by": usual,
        "held-out error [mm]": "" if shrink is None else f"{shrink.base:.1f} -> {shrink.with_effect:.1f}",
    }


def _two(evidence: Mapping[str, float]) -> str:
    """The two effects with most evidence."""
    best = sorted(evidence.items(), key=lambda item: -item[1])[:2]
    return ", ".join(f"{name} {value:.0f}" for name, value in best)


def sessions(found: Sequence[Path], *, table_only: bool) -> None:
    """Answer every scene as a session of one clip and write independent_sessions.md and .csv."""
    for scene in [] if table_only else _missing(found, SESSIONS):
        folder = as_session(scene, SESSIONS / f"{scene.name}_session")
        diagnose_session_folder(folder, SESSIONS / scene.name, ["diagnosis=quick"])
    table = pd.DataFrame([session_row(scene) for scene in found]).fillna("")
    write_text(RESULTS / "independent_sessions.csv", table.to_csv(index=False))
    for run in _withheld(found, SESSIONS):
        GapReport.read(run / DIAGNOSIS_FILE).write(RESULTS / "independent_sessions" / f"{run.name}.json")
    text = f"""# Scenes of the independent engine, each as a session of one clip

Made by `make independent-sessions` (`toile diagnose session=…`, `diagnosis=quick`): 40 frames at 25 frames a
second, corners moved by hand, and the real R1 (50 frames). The labelled scenes helped to develop the method
of single clips, whose answers stand in [independent.md](independent.md); no weight of this one was learnt
from them. The labels of the withheld ones are not known here, and nobody knows R1's cause; whole answers in
`independent_sessions/`.

{table.to_markdown(index=False)}
"""
    write_text(RESULTS / "independent_sessions.md", text)
    print(table.to_string(index=False))


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--table", action="store_true", help="of what is there; diagnose nothing")
    parser.add_argument("--sessions", action="store_true", help="each as a session of one clip")
    arguments = parser.parse_args()
    data = Path(os.environ.get("TOILE_DATA", "data")) / "independent"
    found = scenes(data)
    if arguments.sessions:
        sessions([*found, real(data.parent)], table_only=arguments.table)
        return
    for scene in [] if arguments.table else _missing(found, OUTPUT):
        diagnose_scene(scene, OUTPUT / scene.name, ["workers=2"])
    table = pd.DataFrame([row(s) for s in found]).fillna("")
    write_text(RESULTS / "independent.csv", table.to_csv(index=False))
    for run in _withheld(found, OUTPUT):
        decided(run).write(RESULTS / "independent" / f"{run.name}.json")
    text = f"""# Scenes of the independent engine
Made by `make independent` (`toile diagnose`, default settings); answers from the measured evidence with the
committed calibration, in the table and in the predictions. The labelled scenes helped to develop the
diagnosis and are no test of it (`23a8be`, `69da5d`, `a1cb40` and `f6e34f` are in its calibration); the labels
of the withheld ones are not known here, and the whole answers are in `independent/`.

{table.to_markdown(index=False)}
"""
    write_text(RESULTS / "independent.md", text)
    print(table.to_string(index=False))


if __name__ == "__main__":
    main()
