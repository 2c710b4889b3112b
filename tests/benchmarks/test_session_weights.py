"""Evidence of first clips and of whole sessions is kept side by side, and teaches as what it is."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pandas as pd
import pytest

from toile.diagnosis.effect_evidence import EffectEvidence
from toile.diagnosis.model_errors import ModelErrors
from toile.diagnosis.session_weights import EVIDENCE_FILE, MotionEvidence

ROOT = Path(__file__).parents[2]


@pytest.fixture
def program(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The benchmark, which imports others beside it."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    return importlib.import_module("session_weights")


def diagnosed(folder: Path, drag: float, covered: float | None = None) -> None:
    """A diagnosis whose drag lowers the misfit by so many nats, a share of the cloth's print hidden."""
    drop = EffectEvidence.of(drag, np.array([1.0]), np.array([[0.01]]), 10.0)
    folder.mkdir(parents=True)
    motion = MotionEvidence(
        ModelErrors(100.0, 120.0, 0.001), {"air_drag": drop}, sizes={"air_drag": 0.03}, covered=covered
    )
    motion.write(folder / EVIDENCE_FILE)


def test_first_clip_and_session_are_two_cases(
    program: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    marks, table = tmp_path / "marks.csv", tmp_path / "table.csv"
    about = {"scene": "abc123", "generator": "blender", "truth": "air_drag", "of_the_image": False}
    pd.DataFrame([about]).to_csv(marks, index=False)
    for clips, drag in ((1, 20.0), (3, 50.0), (3, 60.0)):
        answers = tmp_path / f"{clips}_{drag:g}"
        diagnosed(answers / "abc123", drag, covered=None if clips == 1 else 0.07)
        given = ["--clips", str(clips), "--graded", f"{answers}={marks}", "--into", str(table)]
        monkeypatch.setattr(sys, "argv", ["session_weights.py", *given])
        program.main()
    one, three = sorted(program.cases_of(pd.read_csv(table)), key=lambda case: case.clips)
    assert (one.clips, three.clips) == (1, 3)
    assert one.cause == three.cause == "air_drag"
    # Of the same clips the later answer is kept.
    assert one.evidence.effects["air_drag"].drop == pytest.approx(20.0)
    assert three.evidence.effects["air_drag"].drop == pytest.approx(60.0)
    # What the cloth looks like decides as well.
    assert (one.evidence.covered, three.evidence.covered) == (None, 0.07)


def test_only_motions_as_they_are_found_today_teach(
    program: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of corners that may wander by 10 mm, which another width of the same table is of, nothing is learnt."""
    rows = []
    for width, engine, drag in (("2 mm", "toile", 40.0), ("10 mm", "toile", 20.0), ("2 mm", "blender", 30.0)):
        folder = tmp_path / f"{width}_{engine}" / f"{engine}_air_drag_3"
        diagnosed(folder, drag)
        own = program._rows(folder, folder.name, engine, "air_drag", program.REFINED)
        seen = {"change of size [%]": -2.0, program._FREED_SIZE: 1.5}
        rows += [{**row, "width": width, **seen} for row in own]
    pd.DataFrame(rows).to_csv(tmp_path / "held.csv", index=False)
    monkeypatch.setattr(program, "HELD_CORNERS", tmp_path / "held.csv")
    monkeypatch.setattr(program, "HELD", tmp_path / "none.csv")
    known = program.known_cases()
    (own,), (others,) = known["toile"], known["blender"]
    assert own.evidence.effects["air_drag"].drop == pytest.approx(40.0)
    assert others.evidence.effects["air_drag"].drop == pytest.approx(30.0)
    assert own.evidence.resized == pytest.approx(-0.02)
    # A drag is as large as it is beside free forces; under the law it had 3 %.
    assert own.evidence.sizes["air_drag"] == pytest.approx(0.015)
