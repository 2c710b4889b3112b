"""The same clip with the wind open and without one."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType

import pandas as pd
import pytest

from toile.diagnosis.planned_clip import HELD_STILL, STILL_AIR
from toile.scenes.session import load_session

ROOT = Path(__file__).parents[2]


@pytest.fixture
def program(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The benchmark, which imports others beside it."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    return importlib.import_module("still_air")


def test_both_are_of_one_clip_and_differ_in_the_air_alone(
    program: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(program, "FOLDER", tmp_path / "kept")
    (tmp_path / "gusts_3_1" / "clip_0").mkdir(parents=True)
    (tmp_path / "gusts_3_1" / "clip_0" / "scene.json").touch()
    clips = [load_session(program.said_to_be(tmp_path / "gusts_3_1", motion)).clips for motion in program.AIR]
    assert all(clip.folder.resolve() == tmp_path / "gusts_3_1" / "clip_0" for (clip,) in clips)
    motions = [clip.motion for (clip,) in clips]
    assert [motion in STILL_AIR for motion in motions] == [False, True]
    assert all(motion in HELD_STILL for motion in motions)


def test_the_page_says_what_made_it_and_what_has_no_evidence(program: ModuleType) -> None:
    table = pd.read_csv(ROOT / program.TABLE)
    table.loc[0, ["cause [nats]", "revision"]] = [float("nan"), "0123456789abcdef"]
    page = program.page(table)
    assert "at 0123456, " in page
    lines = [line for line in page.splitlines() if line.startswith("| ")]
    assert len(lines) == len(table) + 1
    assert "nan" not in page
    assert "–" in lines[1]
