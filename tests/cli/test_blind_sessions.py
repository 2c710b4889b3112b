"""``toile blind`` on sessions with an injected diagnosis."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
import yaml
from omegaconf import OmegaConf

from toile.blind.run import Predictions, write_predictions
from toile.blind.sealing import BlindSet, SealKey
from toile.cli.blind_sessions import planned_sessions
from toile.physics.simulator import SimulationError
from toile.scenes.native import load_native
from toile.scenes.session import load_session

FAKE = '''
import json
from pathlib import Path
from toile.diagnosis.record import *
from toile.scenes.session import load_session

def oracle(session, out, settings):
    """Names gusts, with as many candidates as there are clips too few; asks for a sway."""
    clips = load_session(session).clips
    assert all((clip.folder / "scene.json").is_file() for clip in clips)
    (out / "clips.txt").write_text(" ".join(clip.motion for clip in clips))
    effect = "gusts" if len(clips) > 1 else "ambiguous"
    report = GapReport(
        Verdict(effect, ("gusts", "air_drag", "none")[: 4 - len(clips)], "actuation", 0.9, "", ""),
        Where({}, (), None), (), Alias(), Protocol(0, (0,), (), "test", "air_drag"),
    ).to_json()
    report["probabilities"] = {"gusts": 0.9, "none": 0.1}
    report["verdict"]["next_recording"] = {"motion": "sway", "gain": 0.5}
    (out / "diagnosis.json").write_text(json.dumps(report))
'''

SMALL = (
    "set=sessions_tiny",
    "out_of_family.grid=[6,6]",
    "out_of_family.n_frames=6",
    "out_of_family.image_side=40",
    "out_of_family.texture_side=40",
    "out_of_family.largest_grid_share=30",
    "bootstrap=20",
    "diagnose=fake_sessions.oracle",
)
NAME = "sessions_tiny"
SET, PREDICTIONS, KEY = (
    Path("outputs/blind") / NAME,
    Path("outputs/blind_predictions") / NAME,
    Path("outputs/blind_keys") / f"{NAME}.blindkey",
)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny set, made once."""
    import os

    from toile.cli.main import main

    folder = tmp_path_factory.mktemp("made")
    before = Path.cwd()
    os.chdir(folder)
    try:
        # A key of its own each time would draw clips that now and then leave the image.
        SealKey.of_seed(3).write(KEY)
        assert main(("blind", "make", *SMALL)) == 0
    finally:
        os.chdir(before)
    return folder


@pytest.fixture
def blind(toile, made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    shutil.copytree(made / "outputs", tmp_path / "outputs")
    modules = tmp_path / "modules"
    modules.mkdir()
    (modules / "fake_sessions.py").write_text(FAKE)
    monkeypatch.syspath_prepend(str(modules))

    def call(action: str, *arguments: str):
        return toile("blind", action, *SMALL, *arguments)

    return call


def test_the_set_tells_nothing(blind) -> None:
    names = BlindSet(SET).names()
    assert len(names) == 3
    assert {p.name for p in SET.iterdir()} == {"set.json", "scenes", "sealed", "commitments.json"}
    for name in names:
        folder = SET / "scenes" / name
        assert {p.name for p in folder.iterdir()} == {"session.yaml", "clip_0", "clip_1"}
        session = load_session(folder)
        assert [clip.motion for clip in session.clips] == ["release", "shake"]
        assert load_native(session.clips[1].folder, crop_margin=None).ground_truth is None
        assert len({p.stat().st_mtime for p in (folder, *folder.rglob("*"))}) == 1
    text = "".join(p.read_text(errors="ignore") for p in SET.rglob("*.json"))
    assert "gusts" not in text
    assert "vortex" not in text
    assert len({p.stat().st_size for p in (SET / "sealed").iterdir()}) == 1


def test_labels_tell_of_every_clip(blind) -> None:
    opened, key = BlindSet(SET), SealKey.read(KEY)
    labels = [opened.open(key, name) for name in opened.names()]
    assert {sealed.label["effect"] for sealed in labels} == {"none", "gusts", "vortex_field"}
    for sealed in labels:
        assert [clip["session"]["motion"] for clip in sealed.label["clips"]] == ["release", "shake"]
        assert sealed.label["n_frames"] == [6, 6]
        assert len(sealed.vertices) == 12


def test_all_acts(blind) -> None:
    """All clips, the first alone, one more as asked for; then the labels are opened once for all."""
    assert blind("run", "max_sessions=1").status == 0
    assert len(list(PREDICTIONS.glob("*/diagnosis.json"))) == 1
    assert blind("run").status == 0
    assert blind("run", "one_clip=true").status == 0
    alone = Path(f"{PREDICTIONS}_one_clip")
    assert {p.read_text() for p in alone.glob("*/clips.txt")} == {"release"}
    # What as_scene=true would answer takes a diagnosis of its own; here the same answers stand for it.
    shutil.copytree(alone, Path(f"{PREDICTIONS}_as_scene"))
    status, out, err = blind("extend")
    assert status == 0, err
    assert "3 of 3 sessions" in out
    assert blind("run", "extended=true").status == 0
    extended = Path(f"{PREDICTIONS}_extended")
    assert {p.read_text() for p in extended.glob("*/clips.txt")} == {"release shake sway"}
    status, _, err = blind("grade", "table=outputs/table.csv")
    assert status == 0, err
    table = pd.read_csv("outputs/table.csv")
    assert set(table["clips"].astype(str)) == {"2", "1", "1, as a scene", "2+1"}
    at = table.set_index(["measure", "generator", "clips"])["value"]
    named = "named rightly, all effects that move"
    assert [at[(named, "toile", clips)] for clips in ("1", "2", "2+1")] == [0.0, 1.0, 1.0]
    size = "90 % set: mean size"
    assert [at[(size, "all", clips)] for clips in ("1", "2", "2+1")] == [3.0, 2.0, 1.0]
    assert at[(size, "all", "1, as a scene")] == 3.0
    assert at[("false alarms on nulls", "all", "2")] == 1.0
    assert "Confusion" in (PREDICTIONS / "grade" / "grade.md").read_text()
    # Spent, whatever was answered from.
    assert blind("run", "one_clip=true").status == 2
    assert blind("extend").status == 2
    assert blind("grade").status == 0


def test_what_was_not_answered_in_time_is_no_answer(blind) -> None:
    """A diagnosis that is laid there after the answers were hashed, or after labels were opened."""
    assert blind("run").status == 0
    late = sorted(PREDICTIONS.glob("*/diagnosis.json"))[0]
    answered = late.read_bytes()
    late.unlink()
    write_predictions(BlindSet(SET), Predictions(PREDICTIONS), incomplete=True)
    assert blind("grade").status == 0
    marks = pd.read_csv(PREDICTIONS / "grade" / "sessions.csv").set_index("scene")
    assert marks.loc[late.parent.name, "answer"] == "no diagnosis"
    late.write_bytes(answered)
    status, _, err = blind("grade")
    assert status == 2
    assert "not answered when answers were hashed" in err


def test_extending_keeps_what_it_has_made(blind) -> None:
    assert blind("run").status == 0
    assert blind("extend").status == 0
    file = next((SET / "extended").glob("*/session.yaml"))
    clips = yaml.safe_load(file.read_text())["clips"]
    assert [clip["motion"] for clip in clips] == ["release", "shake", "sway"]
    assert Path(clips[2]["scene"]).name == "clip_next"
    before = {p: p.read_bytes() for p in (SET / "extended").rglob("*") if p.is_file()}
    assert blind("extend").status == 0
    assert before == {p: p.read_bytes() for p in (SET / "extended").rglob("*") if p.is_file()}


def test_what_cannot_be_made_gives_way_to_what_tells_less(blind, monkeypatch: pytest.MonkeyPatch) -> None:
    from toile.cli import blind_sessions

    tried, original = [], blind_sessions.make_spare_clip

    def without_sway(setup, request, plan, *others):
        tried.append(plan.motion)
        if plan.motion == "sway":
            raise SimulationError("the cloth leaves the image")
        return original(setup, request, plan, *others)

    monkeypatch.setattr(blind_sessions, "make_spare_clip", without_sway)
    assert blind("run").status == 0
    status, out, err = blind("extend")
    assert status == 0, err
    assert "0 of 3 sessions" in out
    assert "leaves the image" in out + err
    for path in PREDICTIONS.glob("*/diagnosis.json"):
        values = json.loads(path.read_text())
        values["verdict"]["next_recording"]["motions"] = ["sway", "hang"]
        path.write_text(json.dumps(values))
    shutil.rmtree(SET / "extended", ignore_errors=True)
    (PREDICTIONS / "predictions.json").unlink()
    assert blind("run").status == 0
    assert "3 of 3 sessions" in blind("extend").out
    assert set(tried) == {"sway", "hang"}


def test_the_engine_that_made_a_cloth_extends_it(blind, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever is wanted, or installed, by then: another one has no cloth like it."""
    from toile.cli import blind_sessions

    original = blind_sessions.planned_sessions

    def by_mujoco(cfg, key):
        sessions, notes = original(cfg, key)
        return tuple(replace(session, generator="mujoco") for session in sessions), notes

    monkeypatch.setattr(blind_sessions, "planned_sessions", by_mujoco)
    monkeypatch.setattr(blind_sessions, "make_spare_clip_with_mujoco", None)
    assert blind("run").status == 0
    status, out, err = blind("extend")
    assert status == 0, err
    assert "3 of 3 sessions" in out


def test_maps_that_are_graded_are_hashed_too(blind) -> None:
    assert blind("run").status == 0
    path = next(PREDICTIONS.glob("*/diagnosis.json"))
    (PREDICTIONS / "predictions.json").unlink()
    values = json.loads(path.read_text())
    values["where"]["acts_on"] = "acts_on_vertices.npy"
    path.write_text(json.dumps(values))
    path.with_name("acts_on_vertices.npy").write_bytes(b"a map")
    assert blind("run").status == 0
    path.with_name("acts_on_vertices.npy").write_bytes(b"another")
    status, _, err = blind("grade")
    assert status == 2
    assert "acts_on_vertices.npy" in err


def test_another_answer_after_extending_is_refused(blind) -> None:
    assert blind("run").status == 0
    path = next(PREDICTIONS.glob("*/diagnosis.json"))
    path.write_text(json.dumps({**json.loads(path.read_text()), "warnings": ["changed"]}))
    status, _, err = blind("extend")
    assert status == 2
    assert "changed" in err


def test_mistakes(blind) -> None:
    assert blind("make", "clips=[wave]").status == 2
    assert blind("make", "clips=[]").status == 2
    assert blind("run", "one_clip=true", "extended=true").status == 2
    assert blind("run", "one_clip=true", "as_scene=true").status == 2


@pytest.mark.parametrize(
    "setting",
    ["clips=[release]", "generators=[mujoco]", "composition=tiny", "composition=sessions_medium"],
)
@pytest.mark.parametrize("action", ["make", "run", "extend", "grade"])
def test_a_set_of_other_sessions_is_not_gone_on_with(blind, action: str, setting: str) -> None:
    """Graded by other measures it would be spent, extended by another plan it would get other cloths."""
    before = BlindSet(SET).description.read_text()
    status, _, err = blind(action, setting)
    assert status == 2
    assert "made with another setting" in err
    assert setting.partition("=")[0] in err
    assert BlindSet(SET).description.read_text() == before
    assert not PREDICTIONS.exists()


def test_another_clip_is_of_the_same_making(blind) -> None:
    assert blind("run").status == 0
    status, _, err = blind("extend", "out_of_family.substeps=9")
    assert status == 2
    assert "out_of_family.substeps" in err


def test_answers_by_other_settings_are_not_mixed(blind) -> None:
    assert blind("run", "max_sessions=1").status == 0
    status, _, err = blind("run", 'settings=["diagnosis=fine"]')
    assert status == 2
    assert "settings" in err
    assert "another predictions" in err
    assert blind("run", 'settings=["diagnosis=fine"]', "predictions=elsewhere").status == 0


def test_a_clip_that_is_made_later_is_not_answered_by_the_copy(blind) -> None:
    """The answer without another clip stands in until there is one."""
    assert blind("run").status == 0
    assert blind("run", "extended=true").status == 0
    folder = PREDICTIONS.with_name(PREDICTIONS.name + "_extended")
    assert len(list(folder.glob("*/copied.txt"))) == len(BlindSet(SET).names())
    assert blind("extend").status == 0
    assert blind("run", "extended=true").status == 0
    extended = replace(BlindSet(SET), part="extended")
    copies = {path.parent.name for path in folder.glob("*/copied.txt")}
    made = {name for name in BlindSet(SET).names() if extended.is_there(name)}
    assert made
    assert not made & copies


def test_what_chosen_generators_cannot_make_is_said() -> None:
    """Blender has no density and no strain stiffening."""
    cfg = OmegaConf.create(
        {
            "composition": "sessions_effects",
            "generators": ["blender"],
            "clips": ["release"],
            "blender": True,
            "mujoco": True,
            "out_of_family": {"n_frames": 6, "fps": 50.0},
        }
    )
    sessions, notes = planned_sessions(cfg, SealKey.of_seed(1))
    unable = [
        session
        for session in sessions
        if session.effects[0][0] in ("nonuniform_density", "strain_stiffening")
    ]
    assert len(unable) == 2
    assert all(session.generator == "toile" for session in unable)
    assert any("2 sessions" in note and "no other one" in note for note in notes)


def test_generators_are_known(toile) -> None:
    status, _, err = toile("blind", "make", *SMALL, "name=mine", "generators=[houdini]")
    assert status == 2
    assert "toile, blender, mujoco" in err
    assert "houdini" in err
