"""session.yaml: what is read is what was written, and what is wrong is said."""

from __future__ import annotations

from pathlib import Path

import pytest

from toile.errors import InputError
from toile.scenes.session import SESSION_FILE, Session, SessionClip, load_session, write_session


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("release", "shake"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "scene.json").write_text("{}")
    return tmp_path


def test_a_session_is_read_as_it_was_written(folder: Path) -> None:
    clips = (
        SessionClip(folder / "release", "release"),
        SessionClip(folder / "shake", "shake", "other phone", ("fan", "turned")),
    )
    session = Session("cloth", clips, plumb_line=True)
    write_session(session, folder)
    assert load_session(folder) == session
    assert load_session(folder / SESSION_FILE) == session


def test_only_the_scenes_are_needed(folder: Path) -> None:
    (folder / SESSION_FILE).write_text("clips:\n- scene: release\n")
    session = load_session(folder)
    assert session.name == folder.name
    assert session.clips == (SessionClip(folder / "release"),)
    assert not session.plumb_line
    assert not session.clock


def test_clips_have_names_of_their_own(folder: Path) -> None:
    """What is said of one must not be taken for what is said of another."""
    for day in ("monday", "tuesday"):
        (folder / day / "native").mkdir(parents=True)
        (folder / day / "native" / "scene.json").write_text("{}")
    (folder / SESSION_FILE).write_text("clips:\n- scene: release\n- scene: shake\n")
    assert load_session(folder).clip_names == ("release", "shake")
    scenes = ("monday/native", "tuesday/native", "release")
    (folder / SESSION_FILE).write_text("clips:\n" + "".join(f"- scene: {scene}\n" for scene in scenes))
    assert load_session(folder).clip_names == ("monday/native", "tuesday/native", f"{folder.name}/release")


@pytest.mark.parametrize(
    ("text", "got"),
    [
        ("clips: []\n", "clips"),
        ("clips:\n- scene: release\n  fps: 3\n", r"clips\[0\].fps"),
        ("clips:\n- scene: sway\n", "sway"),
        ("clips:\n- scene: release\n- scene: shake\n- scene: ./release\n", r"clips\[0\] as well"),
        ("clips: [\n", "while parsing"),
        ("- release\n", "the file"),
        ("clips:\n- scene: release\nclock: maybe\n", "clock"),
    ],
)
def test_what_is_wrong_is_said(folder: Path, text: str, got: str) -> None:
    (folder / SESSION_FILE).write_text(text)
    with pytest.raises(InputError, match=got):
        load_session(folder)


def test_a_forgotten_dash_loses_no_clip(folder: Path) -> None:
    """Of equal keys YAML keeps the last one: a session of two clips was one of the second."""
    text = "clips:\n  - scene: first\n    motion: hang\n    scene: second\n    motion: shake\n"
    (folder / "session.yaml").write_text(text)
    with pytest.raises(InputError) as caught:
        load_session(folder)
    assert "'scene' is given twice" in caught.value.got


def test_a_key_that_is_none_is_answered_with_those_that_are(folder: Path) -> None:
    (folder / "session.yaml").write_text("clips:\n  - scene: first\n    motoin: hang\n")
    with pytest.raises(InputError) as caught:
        load_session(folder)
    assert caught.value.got == "clips[0].motoin"
    assert caught.value.expected == "no other keys than scene, motion, device, changed"


def test_a_missing_file_is_said(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="No such file"):
        load_session(tmp_path)
