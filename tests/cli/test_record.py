"""``toile record``: the session sheet, and the recording that a diagnosis asks for."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml

from toile.cli.record import INSTRUCTIONS
from toile.generation.clip_plan import MOTIONS


def test_every_motion_has_its_instruction() -> None:
    assert set(INSTRUCTIONS) == set(MOTIONS)


def test_the_default_sheet(toile) -> None:
    status, out, err = toile("record")
    assert (status, err) == (0, "")
    assert "80 frames at 50 a second: 1.6 s" in out
    assert "What less costs" in out
    assert "fewer than usual" not in out
    skeleton = yaml.safe_load(out[out.index("clips:\n") :])
    assert [clip["motion"] for clip in skeleton["clips"]] == ["release", "shake", "sway"]
    assert not list(Path().iterdir())


def test_another_sheet(toile) -> None:
    status, out, _ = toile("record", "clips=[turned,fan_off]", "n_frames=40", "fps=25")
    assert status == 0
    assert "40 frames at 25 a second: 1.6 s" in out
    assert "turn the cloth by 90°" in out
    assert "changed: [fan]" in out
    assert "1 clips fewer than usual" in out


@pytest.mark.parametrize("argument", ["clips=[wave]", "clips=[]", "n_frames=1", "fps=0", "clips=3"])
def test_mistakes(toile, argument: str) -> None:
    status, _, err = toile("record", argument)
    assert status == 2
    assert argument.partition("=")[0] in err or "motion" in err


def diagnosis(folder: Path, asked: object) -> Path:
    folder.mkdir()
    (folder / "diagnosis.json").write_text(json.dumps({"verdict": {"next_recording": asked}}))
    return folder


@pytest.mark.parametrize("form", ["diagnosis={}", "run={}", "{}", "{}/diagnosis.json"])
def test_the_next_recording(toile, tmp_path: Path, form: str) -> None:
    folder = diagnosis(tmp_path / "my run", {"motion": "fan_off", "gain": 0.41234, "parts": ["a", "b"]})
    status, out, err = toile("record", form.format(folder))
    assert (status, err) == (0, "")
    assert "Next recording: fan_off" in out
    assert "heating off" in out
    assert "gain: 0.412" in out
    assert "parts: a, b" in out


def test_a_sentence_and_nothing(toile, tmp_path: Path) -> None:
    assert "a slower clip" in toile("record", f"diagnosis={diagnosis(tmp_path / 'a', 'a slower clip')}")[1]
    assert "no other recording" in toile("record", f"diagnosis={diagnosis(tmp_path / 'b', '')}")[1]


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"verdict": 3}', '{"verdict": {"next_recording": 3}}'])
def test_a_diagnosis_that_is_none(toile, tmp_path: Path, text: str) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "diagnosis.json").write_text(text)
    status, _, err = toile("record", f"diagnosis={tmp_path / 'run'}")
    assert status == 2
    assert "No diagnosis can be read" in err
    assert toile("record", "diagnosis=nowhere").status == 2
