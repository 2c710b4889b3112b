"""What speaks for effects that move the cloth by little where nothing acts."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

from toile.diagnosis.session_weights import SessionWeights

ROOT = Path(__file__).parents[2]


def test_no_null_has_as_much_evidence_as_the_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    monkeypatch.chdir(ROOT)
    program = importlib.import_module("small_effects")
    weights = SessionWeights.load()
    nulls = program.of_nulls(program.kept_cases(), weights)
    assert len(nulls) > 100
    assert nulls["e-folds"].max() < weights.surest / 2
    assert f"| {nulls['session'].iloc[0]} " in program.PAGE.read_text()
