"""Evidence of first clips: what is asked for, and what is kept."""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """The command, with its arguments."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    first_clips = importlib.import_module("first_clips")

    def called(*arguments: object) -> None:
        monkeypatch.setattr(sys, "argv", ["first_clips.py", *map(str, arguments)])
        first_clips.main()

    return called


def test_a_folder_without_a_session_is_refused(
    run: Callable[..., None], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stopped:
        run(tmp_path / "nobody", "--out", tmp_path / "out")
    assert stopped.value.code == 2
    assert f"expected folders with session.yaml, got {tmp_path / 'nobody'}" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_what_was_found_before_is_said_again(
    run: Callable[..., None], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session, kept = tmp_path / "none_0_1", tmp_path / "out" / "none_0_1"
    session.mkdir()
    kept.mkdir(parents=True)
    # Nothing can be fitted here: there are no clips.
    (session / "session.yaml").write_text("name: none_0_1\nclips: []\n")
    findings = {"probabilities": {"none": 0.91, "gusts": 0.07}, "CPU [s]": 301.4, "revision": "0123456789"}
    (kept / "findings.json").write_text(json.dumps(findings))
    run(session, "--out", tmp_path / "out")
    assert capsys.readouterr().out == "none_0_1: none 0.910, gusts 0.070 (301 s of the processor, 0123456)\n"
