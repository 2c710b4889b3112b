"""What causes from outside have beside free forces where none of them acts."""

from __future__ import annotations

import importlib
from dataclasses import replace
from pathlib import Path

import pytest

from toile.diagnosis.session_weights import SessionWeights
from toile.effects.catalogue import UNCHANGING

ROOT = Path(__file__).parents[2]


def test_what_is_asked_is_more_than_idle_causes_have(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    monkeypatch.chdir(ROOT)
    program = importlib.import_module("unchanging_causes")
    weights = SessionWeights.load()
    every = program.kept_cases(of_today=True)
    idle = program.where_idle(every).set_index("cause")
    assert idle["cases, own and Blender"].min() > 20
    most = idle["most, own and Blender"]
    for name in UNCHANGING:
        assert most[name] < weights.asked_of_outside(name)
        assert most[name] < most["gusts"]
    teaching = {"teaching": program.by_engines(every)["own and Blender"]}
    asked = {share: replace(weights, outside_unchanging=share) for share in program.SHARES}
    table = program.compared(teaching, "share", asked)
    assert table["share"][table["loss, teaching"].idxmin()] == weights.outside_unchanging
    changed = program.changed(every, program.even(weights), weights)
    # No case loses its cause, and no null gets a name.
    assert (changed["the cause, now"] > changed["the cause, before"]).all()
    text = program.PAGE.read_text()
    assert all(f"| {session} " in text for session in changed["session"])
