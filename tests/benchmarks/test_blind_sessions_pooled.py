"""Marks of several sealed sets in one table."""

from __future__ import annotations

import importlib.util
import shutil
from pathlib import Path
from types import ModuleType

import pandas as pd
import pytest

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "docs" / "results"


@pytest.fixture(scope="module")
def pooled() -> ModuleType:
    """The program."""
    spec = importlib.util.spec_from_file_location("pooled", ROOT / "benchmarks" / "blind_sessions_pooled.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_set_counts_once_and_nulls_are_no_missing_values(pooled: ModuleType, tmp_path: Path) -> None:
    for name in ("_four", "_second_four"):
        shutil.copy(RESULTS / f"blind_sessions{name}_marks.csv", tmp_path)
    every = pooled.marks(tmp_path)
    assert set(every["kind"]) == {"null", "single", "pair"}
    table = pooled.pooled(every).set_index(["version", "clips", "generator", "measure"])["scenes"]
    nulls = "false alarms on nulls"
    # Four sessions by one clip, two of them nulls; four by three clips, three of them nulls.
    assert table[pooled.BEFORE, "1", "all", nulls] == 2
    assert table[pooled.SINCE, "3", "all", nulls] == 3
    assert not any(clips == pooled.SCENE for _, clips, _, _ in table.index)
    record, _ = (page.read_text() for page in pooled.write(tmp_path))
    assert "[four](blind_sessions_four.md) (4)" in record
    assert "nan" not in record


def test_the_method_of_single_clips_is_measured_on_the_same_sessions(
    pooled: ModuleType, tmp_path: Path
) -> None:
    for name in ("_four", "_second_four"):  # the first of them has no such answers
        shutil.copy(RESULTS / f"blind_sessions{name}_marks.csv", tmp_path)
    every = pooled.marks(tmp_path)
    table = pooled.beside_scenes(every).set_index(["clips", "generator", "measure"])["scenes"]
    size = "90 % set: mean size"
    assert table["this method", "all", size] == table[pooled.SCENE, "all", size] > 0
    record, _ = (page.read_text() for page in pooled.write(tmp_path))
    assert "on the same 4 sessions" in record
    (tmp_path / "blind_sessions_second_four_marks.csv").unlink()
    assert "on the same" not in pooled.write(tmp_path)[0].read_text()


def test_a_session_in_two_sets_is_refused(pooled: ModuleType, tmp_path: Path) -> None:
    marks = RESULTS / "blind_sessions_four_marks.csv"
    shutil.copy(marks, tmp_path)
    shutil.copy(marks, tmp_path / "blind_sessions_again_marks.csv")
    with pytest.raises(ValueError, match="every session once"):
        pooled.marks(tmp_path)


def test_maps_of_what_moves_count_no_more(
    pooled: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copy(RESULTS / "blind_sessions_eleventh_medium_marks.csv", tmp_path)
    for known in (False, True):
        monkeypatch.setattr(pooled, "OF_CAUSES", ("eleventh_medium",) if known else ())
        marked = pooled.marks(tmp_path).dropna(subset="vertices_auprc")
        assert ("blender" in set(marked["generator"])) == known
        assert "mujoco" in set(marked["generator"])


def test_the_last_method_is_measured_by_its_own_sets(
    pooled: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("_four", "_second_four"):
        shutil.copy(RESULTS / f"blind_sessions{name}_marks.csv", tmp_path)
    monkeypatch.setattr(pooled, "LAST", ("second_four",))
    _, page = pooled.write(tmp_path)
    assert page == tmp_path / "blind_sessions.md"
    assert "[four]" not in page.read_text()
    table = pd.read_csv(tmp_path / "blind_sessions.csv")
    assert list(table) == ["measure", "generator", "clips", "value", "low", "high", "scenes"]
    nulls = table[(table["measure"] == "false alarms on nulls") & (table["generator"] == "all")]
    assert nulls[["clips", "scenes"]].to_numpy().tolist() == [[3, 3]]


def test_the_committed_page_is_that_of_the_committed_marks(pooled: ModuleType) -> None:
    every = pooled.marks(RESULTS)
    assert (RESULTS / "blind_sessions_pooled.md").read_text() == pooled.markdown(pooled.pooled(every), every)
    last = pooled.last_page(pooled.last(every), every)
    assert (RESULTS / "blind_sessions.md").read_text() == last
