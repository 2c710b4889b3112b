"""``toile calibrate``, and what ``toile diagnose`` says of its probabilities."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from toile.cli.diagnose import diagnose_scene
from toile.diagnosis.arrays import SCREENING_FILE
from toile.diagnosis.decision import Calibration
from toile.diagnosis.made_with import MADE_WITH_FILE, MadeWith
from toile.diagnosis.record import DIAGNOSIS_FILE, GapReport

SCENES = Path(__file__).parents[2] / "docs/results/calibration_scenes.csv"
SCENE = (
    "settings.name=clip",
    "settings.grid=[8,8]",
    "settings.refinement=1",
    "settings.cloth_size=[0.4,0.4]",
    "settings.n_frames=12",
    "settings.substeps=2",
    "settings.image_size=[120,120]",
    "settings.focal_length=170",
    "texture.height=120",
    "texture.width=120",
)
SMALL = (
    "diagnosis=quick",
    "diagnosis.sides=[8]",
    "diagnosis.shooting.modes=2",
    "diagnosis.shooting.window=4",
    "optimization.stages.track.term.per_side=24",
)


def test_uncalibrated_until_there_is_a_calibration_for_the_settings(toile) -> None:
    assert toile("generate", *SCENE).status == 0
    status, out, err = toile("diagnose", "scene=clip", *SMALL, "hydra.run.dir=run")
    assert status == 0
    use = GapReport.read(Path("run") / DIAGNOSIS_FILE).calibration
    assert use is not None
    assert not use.calibrated
    assert use.settings == MadeWith.read(Path("run") / MADE_WITH_FILE).digest
    assert "diagnosis.sides: [8], calibrated with [20]" in use.differences
    assert ", uncalibrated):" in out
    said = "uncalibrated: probabilities were not calibrated for these settings (diagnosis.base_refits: 2"
    assert said in " ".join(err.split())
    assert said in (Path("run") / "diagnose.log").read_text()
    assert "Uncalibrated: no scenes with known effects" in (Path("run") / "index.html").read_text()

    # Other settings than the run's are refused.
    Path("labels.json").write_text(json.dumps({"run": "none"}))
    calibrating = ("calibrate", "run", "labels=labels.json", "output=mine/calibration.json")
    status, _, err = toile(*calibrating, "source=one clip", *SMALL[:1])
    assert status == 2
    assert "diagnosis.sides: [8], asked for: [14]" in err
    status, _, err = toile(*calibrating, *SMALL)
    assert status == 2
    assert "source" in err
    assert not Path("mine").exists()
    status, out, _ = toile(*calibrating, "source=one clip", "scenes=scenes.csv", *SMALL)
    assert status == 0
    assert "which is no test" in out
    made = Calibration.load(Path("mine/calibration.json"))
    assert made.source == "one clip"
    assert made.made_with is not None
    assert made.made_with.digest == use.settings
    # The same from the table.
    again = ("calibrate", "table=scenes.csv", "output=again.json", "source=one clip")
    assert toile(*again, *SMALL).status == 0
    assert Path("again.json").read_text() == Path("mine/calibration.json").read_text()
    status, _, err = toile(*again)
    assert status == 2
    assert "other settings" in err

    scene = next(Path("data").rglob("scene.json")).parent
    noisier = ("diagnosis.brightness.noise=0.2", "diagnosis.outline.correlation=40")
    diagnose_scene(scene, Path("other"), (*SMALL, "diagnosis.calibration=mine/calibration.json", *noisier))
    diagnose_scene(scene, Path("mine"), (*SMALL, "diagnosis.calibration=mine/calibration.json"))
    with_mine = GapReport.read(Path("mine") / DIAGNOSIS_FILE)
    assert with_mine.calibration is not None
    assert with_mine.calibration.calibrated
    assert with_mine.calibration.file == "mine/calibration.json"
    # What is measured does not depend on the calibration, what is made of it does.
    before = GapReport.read(Path("run") / DIAGNOSIS_FILE)
    assert with_mine.where.frames == before.where.frames
    assert with_mine.verdict.probability != before.verdict.probability
    # A constant that is changed changes what it is about, and the calibration is for something else then.
    other = GapReport.read(Path("other") / DIAGNOSIS_FILE).calibration
    assert other is not None
    assert sorted(line.split(":")[0] for line in other.differences) == [
        "diagnosis.brightness.noise",
        "diagnosis.outline.correlation",
    ]
    with np.load(Path("mine") / SCREENING_FILE) as usual, np.load(Path("other") / SCREENING_FILE) as changed:
        names = usual["names"]
        differs = set(names[usual["in_sample"] != changed["in_sample"]].tolist())
    assert differs == {"shading", "mask_bias", "focal_error", "lens_distortion"}


def test_the_shipped_calibration_follows_from_the_committed_scenes(toile) -> None:
    """By the command that the documents name."""
    shipped = Calibration.load()
    status, _, err = toile("calibrate", f"table={SCENES}", "source=the same", "output=made.json")
    assert status == 0
    assert "does not say with which settings" in err
    made = Calibration.load(Path("made.json"))
    assert made.to_json().replace("the same", shipped.source) == shipped.to_json()


def test_scenes_come_from_somewhere_and_once(toile) -> None:
    for arguments, message in (
        ((), "neither"),
        (("run", f"table={SCENES}"), "both"),
        (("run",), "labels"),
        ((f"table={SCENES}", "labels=labels.json"), "labels already"),
        ((f"table={SCENES}", "exact_steps=true"), "left_out"),
    ):
        status, _, err = toile("calibrate", *arguments, "source=test")
        assert status == 2, arguments
        assert message in err
    assert not Path("calibration.json").exists()


def test_a_calibration_that_is_not_there_is_said_before_anything_is_done(toile) -> None:
    assert toile("generate", *SCENE).status == 0
    status, _, err = toile(
        "diagnose", "scene=clip", "diagnosis.calibration=nowhere.json", "hydra.run.dir=run"
    )
    assert status == 2
    assert "nowhere.json" in err
    assert not list(Path("run").glob("*.npz"))


def test_left_out_answers_every_scene_and_writes_nothing(toile) -> None:
    lines = SCENES.read_text().splitlines(keepends=True)
    names = list(dict.fromkeys(line.split(",")[0] for line in lines[1:]))
    kept = [line for line in lines[1:] if line.split(",")[0] in {*names[:8], "n1", "n2", "n3"}]
    Path("few.csv").write_text("".join([lines[0], *kept]))
    status, out, _ = toile("calibrate", "table=few.csv", "left_out=true")
    assert status == 0
    assert "log score" in out
    assert "named wrongly" in out
    assert not Path("calibration.json").exists()
    _, weighed, _ = toile(
        "calibrate", "table=few.csv", "left_out=true", "diagnosis.weights.in_sample=0.1", "exact_steps=true"
    )
    assert weighed.splitlines()[-1] != out.splitlines()[-1]
