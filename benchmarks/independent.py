"""Diagnose the scenes of the independent engine: ``docs/results/independent.md`` and ``.csv``.

    make independent

Labels are read for the table alone, after all answers are there, and only where they are open; those of the
withheld scenes are nowhere to be read. What is done is kept in ``outputs/independent``.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

import toile.cli  # noqa: F401  # isort: skip  # first, because it sets the number of threads

import pandas as pd

from toile.atomic_file import write_text
from toile.cli.diagnose import diagnose_scene
from toile.evaluation.diagnosis_record import DIAGNOSIS_FILE, GapReport

OUTPUT = Path("outputs/independent")
RESULTS = Path("docs/results")


def scenes(data: Path) -> list[Path]:
    """Folders of the scenes, labelled ones first."""
    return [p for part in ("labelled", "withheld") for p in sorted((data / part).iterdir()) if p.is_dir()]


def row(scene: Path, report: GapReport) -> dict[str, str]:
    """One line of the table."""
    verdict = report.verdict
    label = scene / "label.json"
    first = report.effect(verdict.effect)
    shrink = first.shrink if first is not None else None
    return {
        "scene": scene.name,
        "label": json.loads(label.read_text())["effect"] if label.is_file() else "withheld",
        "answer": verdict.effect,
        "candidates": ", ".join(verdict.candidates),
        "stage": verdict.stage,
        "probability": f"{verdict.probability:.2f}",
        "naive": report.protocol.naive,
        "held-out error [mm]": "" if shrink is None else f"{shrink.base:.1f} -> {shrink.with_effect:.1f}",
    }


def main() -> None:
    """See the module."""
    data = Path(os.environ.get("TOILE_DATA", "data")) / "independent"
    found = scenes(data)
    for scene in found:
        if not (OUTPUT / scene.name / DIAGNOSIS_FILE).is_file():
            print(scene.name, flush=True)
            diagnose_scene(scene, OUTPUT / scene.name, None)
    table = pd.DataFrame([row(s, GapReport.read(OUTPUT / s.name / DIAGNOSIS_FILE)) for s in found])
    write_text(RESULTS / "independent.csv", table.to_csv(index=False))
    for scene in found:
        if not (scene / "label.json").is_file():
            answer = (OUTPUT / scene.name / DIAGNOSIS_FILE).read_text()
            write_text(RESULTS / "independent" / f"{scene.name}.json", answer)
    text = f"""# Scenes of the independent engine
Made by `make independent` (`toile diagnose`, default settings). The labelled scenes helped to develop the
diagnosis and are no test of it; the labels of the withheld ones are not known here, and the whole answers
are in `independent/`.

{table.to_markdown(index=False)}
"""
    write_text(RESULTS / "independent.md", text)
    print(table.to_string(index=False))


if __name__ == "__main__":
    main()
