"""``toile blind make | run | grade`` with an injected diagnosis."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from toile.blind.sealing import BlindSet, SealKey

FAKE = '''
import os
from pathlib import Path
import numpy as np
from toile.diagnosis.record import *

def oracle(scene, out, settings):
    """Always names gusts; as right as the set allows."""
    assert scene.parent.name == "scenes"
    assert not (scene / "ground_truth").exists()
    np.save(out / "vertices.npy", np.ones((6, 6)))
    shrink = Shrink("position", "late", 10.0, 4.0, 0.6, 0.5, 0.7, 0.1)
    GapReport(
        Verdict("gusts", ("gusts",), "actuation", 0.9, "", ""),
        Where({"actuation": 1.0}, (1.0,) * 6, "vertices.npy"),
        (EffectReport("gusts", "actuation", 0.9, {}, shrink),),
        Alias(("gusts",), ((1.0,),), {"gusts": 0.1}),
        Protocol(0, (0, 1, 2, 3), (4, 5), "test", "air_drag"),
    ).write(out / "diagnosis.json")

def spy(scene, out, settings):
    """Tries every way to the labels that Python has."""
    base = scene.parent.parent
    ways = [
        lambda: list((base / "sealed").iterdir()),
        lambda: os.listdir(base / "sealed"),
        lambda: (base / "commitments.json").read_text(),
        lambda: open(settings[0], "rb").read(),
        lambda: np.load(settings[0]),
        lambda: Path(settings[1]).read_text(),
        lambda: os.open(settings[0], os.O_RDONLY),
    ]
    refused = 0
    for way in ways:
        try:
            way()
        except PermissionError:
            refused += 1
    assert refused == len(ways), refused
    oracle(scene, out, settings)

def broken(scene, out, settings):
    raise ValueError("no idea")
'''

SMALL = (
    "blind=tiny",
    "out_of_family.grid=[6,6]",
    "out_of_family.n_frames=6",
    "out_of_family.substeps=3",
    "out_of_family.image_side=40",
    "out_of_family.texture_side=40",
    "out_of_family.largest_grid_share=20",
)
SET, PREDICTIONS, KEY = (
    Path("outputs/blind/tiny"),
    Path("outputs/blind_predictions/tiny"),
    Path("outputs/blind_keys/tiny.blindkey"),
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
        assert main(("blind", "make", *SMALL)) == 0
    finally:
        os.chdir(before)
    return folder


@pytest.fixture
def blind(toile, made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The set in the folder of this test, with fake diagnoses to choose from."""
    shutil.copytree(made / "outputs", tmp_path / "outputs")
    modules = tmp_path / "modules"
    modules.mkdir()
    (modules / "fake_diagnosis.py").write_text(FAKE)
    # The child processes take sys.path over.
    monkeypatch.syspath_prepend(str(modules))

    def call(action: str, *arguments: str):
        return toile("blind", action, *SMALL, "diagnose=fake_diagnosis.oracle", *arguments)

    return call


def test_the_set_tells_nothing(blind) -> None:
    names = json.loads((SET / "set.json").read_text())["scenes"]
    assert len(names) == 3
    there = {p.name for p in SET.iterdir()}
    assert there == {"set.json", "scenes", "sealed", "commitments.json"}
    for name in names:
        files = {p.name for p in (SET / "scenes" / name).iterdir()}
        assert files == {"scene.json", "template.obj", "texture.png", "rgbs", "masks"}
    text = "".join(p.read_text(errors="ignore") for p in SET.rglob("*.json"))
    assert "gusts" not in text
    assert "vortex" not in text
    sizes = {p.stat().st_size for p in (SET / "sealed").iterdir()}
    assert len(sizes) == 1


def test_a_set_may_be_cut_short_and_grows_again(blind) -> None:
    names = json.loads((SET / "set.json").read_text())["scenes"]
    assert blind("make", "first=2").status == 0
    cut = json.loads((SET / "set.json").read_text())
    assert cut["scenes"] == names[:2]
    assert "first 2 of 3" in " ".join(cut["notes"])
    assert set(json.loads((SET / "commitments.json").read_text())["commitments"]) == set(names[:2])
    # What only cuts a set when it is made is refused elsewhere, not ignored.
    refused = blind("run", "first=1")
    assert refused.status != 0
    assert "another number of scenes" in refused.err
    assert blind("run").status == 0
    assert blind("make").status == 0
    assert json.loads((SET / "set.json").read_text())["scenes"] == names


def test_make_again_changes_nothing_and_makes_what_is_missing(blind) -> None:
    files = {p: p.read_bytes() for p in SET.rglob("*") if p.is_file()}
    assert blind("make").status == 0
    assert {p: p.read_bytes() for p in SET.rglob("*") if p.is_file()} == files
    name = json.loads((SET / "set.json").read_text())["scenes"][0]
    shutil.rmtree(SET / "scenes" / name)
    assert blind("make").status == 0
    scene = SET / "scenes" / name
    assert all(files[p] == p.read_bytes() for p in scene.rglob("*") if p.is_file())


def test_three_acts(blind) -> None:
    status, out, err = blind("run")
    assert status == 0, err
    digest = (PREDICTIONS / "predictions.sha256").read_text().strip()
    assert digest in out
    assert not (PREDICTIONS / "grade").exists()
    assert blind("grade").status == 0
    measures = pd.read_csv(PREDICTIONS / "grade" / "measures.csv").set_index("measure")
    assert measures.loc["top-1 effect, identifiable singles", "value"] == 1.0
    assert measures.loc["top-1 effect, identifiable singles", "naive"] == 0.0
    assert measures.loc["false alarms on nulls", "value"] == 1.0
    assert "| gusts " in (PREDICTIONS / "grade" / "grade.md").read_text()
    assert (PREDICTIONS / "grade" / "shrink.svg").is_file()
    # Spent: no second answer, but the same marks again.
    status, _, err = blind("run")
    assert status == 2
    assert "opened" in err
    assert blind("run", "predictions=outputs/elsewhere").status == 2
    assert blind("grade").status == 0


def test_changed_prediction_is_refused(blind) -> None:
    assert blind("run").status == 0
    path = next(PREDICTIONS.glob("*/diagnosis.json"))
    path.write_text(path.read_text().replace("gusts", "contact"))
    status, _, err = blind("grade")
    assert status == 2
    assert "changed" in err
    assert not (SET / "opened.json").exists()


def test_changed_commitment_is_refused(blind) -> None:
    assert blind("run").status == 0
    path = SET / "commitments.json"
    values = json.loads(path.read_text())
    name = next(iter(values["commitments"]))
    values["commitments"][name] = "0" * 64
    path.write_text(json.dumps(values))
    status, _, err = blind("grade")
    assert status == 2
    assert "committed" in err


def test_run_cannot_read_labels(blind) -> None:
    """Even as root: not the sealed files, and not a key whose place it is told."""
    label = next((SET / "sealed").iterdir()).resolve()
    status, _, err = blind(
        "run",
        "diagnose=fake_diagnosis.spy",
        f"settings=['{label}','{KEY.resolve()}']",
    )
    assert status == 0, err


@pytest.mark.parametrize(
    "where", [SET / "sealed" / "label.json", SET / "scenes" / "truth.json", SET.parent / "a.blindkey"]
)
def test_run_refuses_open_labels(blind, where: Path) -> None:
    where.write_text("{}")
    status, _, err = blind("run")
    assert status == 2
    assert "within reach" in err


def test_run_refuses_a_renamed_key(blind) -> None:
    shutil.copy(KEY, SET / "scenes" / "notes.txt")
    assert blind("run").status == 2


def test_failing_diagnosis_resumes(blind) -> None:
    status, out, _ = blind("run", "diagnose=fake_diagnosis.broken")
    assert status == 3
    assert "no idea" in out
    assert not (PREDICTIONS / "predictions.json").exists()
    assert blind("run").status == 0
    assert (PREDICTIONS / "predictions.json").exists()


def test_incomplete_counts_as_wrong(blind) -> None:
    assert blind("run", "diagnose=fake_diagnosis.broken", "incomplete=true").status == 0
    assert blind("grade").status == 0
    measures = pd.read_csv(PREDICTIONS / "grade" / "measures.csv").set_index("measure")
    assert measures.loc["stage accuracy", "value"] == 0.0


def test_labels_are_true(blind) -> None:
    """What grade opens: one of each kind, and a gap that the vertices show."""
    opened = BlindSet(SET)
    key = SealKey.read(KEY)
    found = {}
    for name in opened.names():
        sealed = opened.open(key, name)
        found[sealed.label["effect"]] = sealed
    assert set(found) == {"none", "gusts", "vortex_field"}
    for effect, sealed in found.items():
        moved = np.abs(sealed.vertices - sealed.twin).max()
        assert (moved == 0) == (effect == "none")


def test_mistakes(blind, toile) -> None:
    assert blind("peek").status == 2
    assert blind("grade", "key=nowhere.blindkey").status == 2
    assert blind("make", f"key={SET}/key.blindkey").status == 2
    assert blind("make", "key=outputs/other.blindkey").status == 2
    assert blind("make", "composition=huge").status == 2
    assert blind("run", "diagnose=nothing.there").status == 2
    assert blind("make", "part=2", "parts=2").status == 2
    assert toile("blind", "make", "set=sessions_tiny", "name=x", "clips=[wave]").status == 2
    assert not Path("outputs/blind_keys/x.blindkey").exists()


def test_the_tiny_set_through_the_real_diagnosis(toile) -> None:
    """Three scenes from their making to their marks, as the command line ships it."""
    assert toile("blind", "make", "blind=tiny").status == 0
    status, out, _ = toile("blind", "run", "blind=tiny")
    assert status == 0
    assert "sha256" in out
    assert toile("blind", "grade", "blind=tiny").status == 0
    scenes = pd.read_csv("outputs/blind_predictions/tiny/grade/scenes.csv")
    assert len(scenes) == 3
