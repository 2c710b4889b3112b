from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from toile.atomic_file import written_atomically
from toile.errors import InputError
from toile.reports import run_folder as rf


@pytest.fixture
def run(tmp_path: Path) -> rf.RunFolder:
    return rf.create_run_folder(tmp_path / "a" / "run")


def positions() -> np.ndarray:
    return np.random.default_rng(0).normal(size=(3, 4, 5, 3))


def test_everything_reads_back_exactly(run: rf.RunFolder) -> None:
    rf.write_config(run, "scene: R1\nnote: Größe\n")
    rf.write_git_revision(run, "abc-dirty")
    rf.write_metrics(run, {"chamfer": 0.1 + 0.2, "missing": None, "unit": "m²"})
    rf.write_trajectory(run, positions(), fps=29.97, parameters={"stretching": 3000.1, "names": ["a", "b"]})
    history = pd.DataFrame({"cycle": [0, 1], "loss": [0.1 + 0.2, 1e-17], "stretching [N/m]": [math.nan, 2.0]})
    rf.write_history(run, history)

    again = rf.open_run_folder(run.path)
    assert rf.read_config(again) == "scene: R1\nnote: Größe\n"
    assert rf.read_git_revision(again) == "abc-dirty"
    assert rf.read_metrics(again) == {"chamfer": 0.1 + 0.2, "missing": None, "unit": "m²"}
    saved = rf.read_trajectory(again)
    assert np.array_equal(saved.positions, positions())
    assert saved.positions.dtype == np.float64
    assert saved.fps == 29.97
    assert float(saved.parameters["stretching"]) == 3000.1
    assert saved.parameters["names"].tolist() == ["a", "b"]
    pd.testing.assert_frame_equal(rf.read_history(again), history, rtol=1e-15, atol=0.0)


def test_nothing_but_the_named_files_is_left(run: rf.RunFolder) -> None:
    rf.write_trajectory(run, positions(), fps=50)
    rf.write_metrics(run, {})
    assert sorted(p.name for p in run.path.iterdir()) == ["figures", "metrics.json", "trajectory.npz"]


def test_a_failed_write_keeps_the_old_file(run: rf.RunFolder) -> None:
    rf.write_config(run, "old")

    def fail_halfway() -> None:
        with written_atomically(run.config) as temporary:
            temporary.write_text("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail_halfway()
    assert rf.read_config(run) == "old"
    assert sorted(p.name for p in run.path.iterdir()) == ["config.yaml", "figures"]


def test_metrics_must_be_strict_json(run: rf.RunFolder) -> None:
    for bad in ({"x": math.nan}, {"x": math.inf}, {"x": object()}):
        with pytest.raises(InputError, match="JSON"):
            rf.write_metrics(run, bad)
    assert not run.metrics.exists()


def test_a_trajectory_brings_what_it_takes_to_use_it(run: rf.RunFolder) -> None:
    x, times = positions(), [0.0, 0.02, 0.1, 0.15][: len(positions())]
    K = [[700.0, 0.0, 320.0], [0.0, 710.0, 240.0], [0.0, 0.0, 1.0]]
    rf.write_trajectory(
        run,
        x,
        fps=20.0,
        times=times,
        faces=[[0, 1, 2]],
        intrinsics=K,
        image_size=(480, 640),
        gravity=[0.0, 9.81, 0.0],
    )
    saved = rf.read_trajectory(run)
    assert saved.times.tolist() == times
    assert saved.faces is not None
    assert saved.faces.tolist() == [[0, 1, 2]]
    assert saved.intrinsics is not None
    assert saved.intrinsics.tolist() == K
    assert saved.image_size == (480, 640)
    assert saved.gravity is not None
    assert saved.gravity.tolist() == [0.0, 9.81, 0.0]
    assert saved.parameters == {}


def test_trajectories_of_format_1_are_read(run: rf.RunFolder) -> None:
    np.savez(run.trajectory, positions=positions(), fps=25.0, stretching=3000.0)
    saved = rf.read_trajectory(run)
    assert saved.times.tolist() == pytest.approx([k / 25 for k in range(len(positions()))])
    assert saved.faces is None
    assert list(saved.parameters) == ["stretching"]


def test_later_formats_are_refused(run: rf.RunFolder) -> None:
    np.savez(run.trajectory, positions=positions(), fps=25.0, format=rf.TRAJECTORY_FORMAT + 1)
    with pytest.raises(InputError, match="later version"):
        rf.read_trajectory(run)


@pytest.mark.parametrize("bad", [np.zeros((3, 20, 3)), np.full((1, 2, 2, 3), np.nan)], ids=["shape", "nan"])
def test_bad_positions_are_refused(run: rf.RunFolder, bad: np.ndarray) -> None:
    with pytest.raises(InputError, match=r"\(F, H, W, 3\)"):
        rf.write_trajectory(run, bad, fps=50)


@pytest.mark.parametrize(("name", "value"), [("fps", 1.0), ("positions", 1.0), ("object", object())])
def test_parameters_that_need_a_pickle_or_a_taken_name_are_refused(
    run: rf.RunFolder, name: str, value: object
) -> None:
    with pytest.raises(InputError, match=name):
        rf.write_trajectory(run, positions(), fps=50, parameters={name: value})  # type: ignore[dict-item]


def test_pickled_trajectories_are_not_loaded(run: rf.RunFolder) -> None:
    np.savez(run.trajectory, positions=np.array([object()]), fps=1.0)
    with pytest.raises(InputError, match="cannot be read"):
        rf.read_trajectory(run)


@pytest.mark.parametrize("reader", [rf.read_trajectory, rf.read_metrics, rf.read_history, rf.read_config])
def test_missing_files_are_named(run: rf.RunFolder, reader: object) -> None:
    with pytest.raises(InputError, match="missing"):
        reader(run)  # type: ignore[operator]


def test_damaged_files_are_named(run: rf.RunFolder) -> None:
    rf.write_trajectory(run, positions(), fps=50)
    run.trajectory.write_bytes(run.trajectory.read_bytes()[:200])
    run.metrics.write_text("[1, 2]")
    run.history.write_text("")
    for reader in (rf.read_trajectory, rf.read_metrics, rf.read_history):
        with pytest.raises(InputError, match="cannot be read"):
            reader(run)


def test_folders_that_are_no_run_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        rf.open_run_folder(tmp_path / "nowhere")
    with pytest.raises(InputError, match="empty folder"):
        rf.open_run_folder(tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="run folder"):
        rf.create_run_folder(tmp_path / "file")


def test_git_revision_outside_a_repository_is_unknown(tmp_path: Path) -> None:
    assert rf.current_git_revision(tmp_path) == "unknown"
    assert len(rf.current_git_revision()) >= 7


def test_times_of_the_frames_are_kept(tmp_path: Path) -> None:
    run = rf.create_run_folder(tmp_path / "run")
    x = np.zeros((3, 2, 2, 3))
    rf.write_trajectory(run, x, fps=20.0, times=[0.0, 0.02, 0.1])
    saved = rf.read_trajectory(run)
    assert saved.uneven_times is not None
    assert saved.uneven_times.tolist() == [0.0, 0.02, 0.1]
    assert "times" not in saved.parameters
    rf.write_trajectory(run, x, fps=20.0)
    saved = rf.read_trajectory(run)
    assert saved.uneven_times is None
    assert saved.times.tolist() == [0.0, 0.05, 0.1]
