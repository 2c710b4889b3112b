"""Files of earlier versions are read; settings of earlier versions get their present name told."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from toile import former_names
from toile.blind.calibration import read_table
from toile.cli.main import main
from toile.diagnosis.made_with import MadeWith
from toile.reports.run_folder import create_run_folder, read_trajectory
from toile.scenes.native import load_native, write_native
from toile.scenes.scene import Scene


@pytest.mark.parametrize(
    ("former", "present"),
    [
        ("callbacks.curves.every", "trainer.log_every_n_steps"),
        ("diagnosis.grip.settling", "diagnosis.attachment_slip.first_frames"),
        ("diagnosis.grip.along", "diagnosis.attachment_slip.along"),
        ("diagnosis.border.steps", "diagnosis.outline.steps"),
        ("diagnosis.borders", "diagnosis.borders"),
        ("optimization.stages.track.priors.anchor_motion_time", None),
        ("optimization.stages.track.iterations", "optimization.stages.track.iterations"),
    ],
)
def test_names_of_settings(former: str, present: str | None) -> None:
    assert former_names.setting(former) == (present or former.replace("anchor", "boundary"))


def test_present_names_stay() -> None:
    for name in former_names.SETTINGS.values():
        assert former_names.setting(name) == name


def test_a_value_under_its_present_name_wins() -> None:
    assert former_names.renamed({"a": 1, "b": 2, "c": 3}, {"a": "b"}) == {"b": 2, "c": 3}


def test_scene_file(tiny_scene: Scene, tmp_path: Path) -> None:
    folder = write_native(tiny_scene, tmp_path / "scene")
    path = folder / "scene.json"
    values = json.loads(path.read_text())
    assert values["pinned_vertices"]
    values["held_vertices"] = values.pop("pinned_vertices")
    path.write_text(json.dumps(values))
    assert load_native(folder).pinned_vertices == tiny_scene.pinned_vertices


def test_trajectory(tmp_path: Path) -> None:
    run = create_run_folder(tmp_path / "run")
    arrays = {"anchor motion [m]": np.ones((2, 1, 3)), "held vertices": np.array([3])}
    positions = np.zeros((2, 2, 2, 3))
    np.savez(
        run.trajectory, allow_pickle=False, format=2, positions=positions, fps=25.0, times=[0, 1], **arrays
    )
    found = read_trajectory(run).parameters
    np.testing.assert_array_equal(found["boundary motion [m]"], np.ones((2, 1, 3)))
    assert found["pinned vertices"].tolist() == [3]


def test_settings_that_evidence_was_made_with(tmp_path: Path) -> None:
    former = MadeWith(
        {
            "diagnosis.grip.along": 5.0,
            "diagnosis.weights.hindsight": 0.5,
            "optimization.stages.track._target_": "Stage",
        }
    )
    present = {
        "diagnosis": {"attachment_slip": {"along": 5.0}, "weights": {"in_sample": 0.5}},
        "optimization": {"stages": {"track": {"_target_": "toile.reconstruction.recipe.TrackingStage"}}},
    }
    read = MadeWith.read(former.write(tmp_path / "made_with.json"))
    assert read.differences(MadeWith.of(present)) == ()
    assert read.digest == MadeWith.of(present).digest


def test_table_of_measured_scenes(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_text(
        "scene,truth,effect,hindsight,foretold,size,left,step\na,none,air_drag,2.5,,0.01,3,0.001\n"
    )
    (row,) = read_table(path, MadeWith({})).itertuples()
    assert row.in_sample == 2.5
    assert np.isnan(row.prediction_gain)


def test_a_setting_by_its_former_name(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fit", "scene=R1", "scene.held_vertices=[0]"]) == 2
    assert "It is called scene.pinned_vertices now" in capsys.readouterr().err
