"""Sweeps: over ablations, interrupted and continued, with failing runs, through every launcher."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from toile.learning.fit.module import FitModule
from toile.reports.run_folder import RunFolder, read_metrics, read_trajectory
from toile.scenes.native import write_native
from toile.scenes.scene import Scene

Toile = Callable[..., Any]
QUICK = ("scene=swaying", "logger=none", "report.video=false", "report.page=false", "callbacks=default")
SHORT = (
    *QUICK,
    "optimization=adam",
    "optimization.cycles=2",
    "optimization.first_frames=3",
    "simulator.substeps=1",
    "callbacks.checkpoint.every=1",
)
ABLATIONS = (*SHORT, "hydra=ablations", "hydra/launcher=basic")


@pytest.fixture(autouse=True)
def swaying(swaying_scene: Scene, tmp_path: Path) -> Path:
    """The scene "swaying" in the data folder."""
    return write_native(swaying_scene, tmp_path / "data" / "made" / "swaying")


def table(toile: Toile, folder: str) -> pd.DataFrame:
    """The table of a sweep, without times."""
    outcome = toile("tables", folder, "output=tables", "metrics=[chamfer,silhouette_iou]")
    assert outcome.status == 0, outcome.err
    return pd.read_csv("tables/ablations.csv")


def test_a_failing_cell_is_reported_and_the_rest_goes_on(toile: Toile, tmp_path: Path) -> None:
    # The paper's optimisation has no stage that calibrates.
    outcome = toile("fit", "-m", *ABLATIONS, "ablation=none,no_calibration,no_uv")
    assert outcome.status == 2
    assert "2 of 3 runs in outputs/ablations/adam have a result" in outcome.err
    assert "swaying/no_calibration/seed0: error: The optimisation does not know this ablation" in outcome.err
    cells = table(toile, "outputs/ablations/adam")
    assert list(cells.ablation[cells.metric == "chamfer"]) == ["no_uv", "none"]
    markdown = Path("tables/ablations.md").read_text()
    assert "`swaying/no_calibration/seed0`: error: The optimisation does not know" in markdown
    assert markdown.index("| none") < markdown.index("| no_uv")
    for run in cells.runs:
        assert (tmp_path / "outputs/ablations/adam" / run / "metrics.json").is_file()


def test_a_run_of_a_sweep_that_is_finished_by_itself_has_not_failed(toile: Toile) -> None:
    run = Path("runs/0")
    run.mkdir(parents=True)
    (run / "failure.txt").write_text("error: no space left\n")
    assert toile("fit", *SHORT, f"hydra.run.dir={run}").status == 0
    assert (run / "metrics.json").is_file()
    assert not (run / "failure.txt").exists()


def test_a_refused_call_says_nothing_against_the_run_that_is_there(toile: Toile) -> None:
    assert toile("fit", "-m", *SHORT, "hydra.sweep.dir=runs").status == 0
    (run,) = (path.parent for path in Path("runs").glob("*/metrics.json"))
    refused = toile("fit", "-m", *SHORT, "seed=3", "hydra.sweep.dir=runs")
    assert refused.status == 2
    assert "other settings" in refused.err
    assert not (run / "failure.txt").exists()
    (run / "failure.txt").write_text("error: no space left\n")
    assert toile("fit", "-m", *SHORT, "seed=3", "hydra.sweep.dir=runs").status == 2
    assert (run / "failure.txt").read_text() == "error: no space left\n"


def test_commands_without_a_folder_leave_what_lies_there(toile: Toile) -> None:
    """Standing in the folder of a failed run, a question lost why it had failed."""
    Path("failure.txt").write_text("error: no space left\n")
    toile("record")
    toile("doctor", "scene=swaying")
    toile("report", ".")
    assert Path("failure.txt").read_text() == "error: no space left\n"


def test_an_interrupted_sweep_ends_with_the_same_table(toile: Toile, monkeypatch: pytest.MonkeyPatch) -> None:
    sweep = ("fit", "-m", *ABLATIONS, "ablation=none,no_silhouette", "seed=0,1")
    assert toile(*sweep, "paths.outputs=whole").status == 0

    step, cycles = FitModule.training_step, []

    def killed(self: FitModule, batch: int, batch_idx: int) -> None:
        cycles.append(batch)
        if len(cycles) == 4:  # in the second cell
            raise KeyboardInterrupt
        step(self, batch, batch_idx)

    with monkeypatch.context() as patch:
        patch.setattr(FitModule, "training_step", killed)
        assert toile(*sweep, "paths.outputs=halved").status == 130
    first = Path("halved/ablations/adam/swaying/none/seed0/metrics.json")
    before = first.stat().st_mtime_ns
    outcome = toile(*sweep, "paths.outputs=halved")
    assert outcome.status == 0, outcome.err
    assert "finished before with the same settings" in outcome.out
    assert first.stat().st_mtime_ns == before
    whole = table(toile, "whole/ablations/adam")
    pd.testing.assert_frame_equal(whole, table(toile, "halved/ablations/adam"))
    assert set(whole.seeds) == {2}


def test_a_cell_with_other_settings_is_no_cell_of_this_sweep(toile: Toile) -> None:
    sweep = ("fit", "-m", *ABLATIONS, "ablation=none,no_uv")
    assert toile(*sweep).status == 0
    outcome = toile(*sweep, "parameters.bending=2")
    assert outcome.status == 2
    assert "The folder holds a run with other settings" in outcome.err
    assert "parameters.bending: 2 instead of 1.0" in outcome.err


def test_rows_of_a_table_are_one_set_of_settings(toile: Toile) -> None:
    for seed in (0, 1):
        other = f"parameters.bending={1 + seed}"
        assert toile("fit", *SHORT, f"seed={seed}", other, f"hydra.run.dir=runs/{seed}").status == 0
    outcome = toile("tables", "runs")
    assert outcome.status == 2
    assert "differ in more than scene and seed" in outcome.err
    assert "bending: 1.0, 2" in outcome.err or "bending: 1, 2" in outcome.err


def test_tables_stand_beside_the_runs_unless_asked_for_elsewhere(toile: Toile, tmp_path: Path) -> None:
    assert toile("fit", *SHORT, "hydra.run.dir=runs/a").status == 0
    before = set(tmp_path.iterdir())
    outcome = toile("tables", "runs")
    assert outcome.status == 0, outcome.err
    assert {p.name for p in (tmp_path / "runs" / "tables").iterdir()} == {
        f"ablations.{s}" for s in ("csv", "md", "tex")
    }
    # Nor are the tables taken for a run.
    assert toile("tables", "runs").status == 0
    outcome = toile("tables", "runs/a", "runs")
    assert outcome.status == 2
    assert "output=<folder>" in outcome.err
    assert set(tmp_path.iterdir()) == before


def test_the_papers_fits_differ_by_nothing_but_their_settings(toile: Toile) -> None:
    """So its table is made of one fit a cell, measured with several seeds of the metric's samples."""
    network = ("optimization=adam", "simulator=surrogate", "simulator/gradient=backprop")
    for seed in (0, 1):
        outcome = toile("fit", *SHORT, *network, f"seed={seed}", f"hydra.run.dir=runs/{seed}")
        assert outcome.status == 0, outcome.err
    first, second = (RunFolder(Path("runs") / name) for name in "01")
    np.testing.assert_array_equal(read_trajectory(first).positions, read_trajectory(second).positions)

    make = ("tables", "runs/0", "seeds=[0,1]", "metrics=[chamfer]")
    outcome = toile(*make)
    assert outcome.status == 0, outcome.err
    cell = pd.read_csv("runs/0/tables/ablations.csv").iloc[0]
    both = [read_metrics(run)["metrics"]["chamfer"]["mean"] for run in (first, second)]
    assert cell.seeds == 2
    assert (cell["mean"], cell.deviation) == pytest.approx((np.mean(both), np.std(both, ddof=1)), rel=1e-9)
    assert cell.deviation > 0

    # Measured once, and again when the motion is another.
    stored = first.metrics_of_seed(1)
    before = stored.stat().st_mtime_ns
    assert toile(*make).status == 0
    assert stored.stat().st_mtime_ns == before
    os.utime(first.trajectory)
    assert toile(*make).status == 0
    assert stored.stat().st_mtime_ns > before


def test_an_unknown_metric_is_one_clear_message(toile: Toile) -> None:
    assert toile("fit", *SHORT, "hydra.run.dir=runs/a").status == 0
    outcome = toile("tables", "runs", "metrics=[nonsense]")
    assert outcome.status == 2
    assert "chamfer" in outcome.err
    outcome = toile("fit", *SHORT, "objective=nonsense", "hydra.run.dir=runs/b")
    assert outcome.status == 2
    assert "The objective was not measured" in outcome.err


@pytest.mark.parametrize("launcher", ["joblib", "submitit_local", "ray"])
def test_launchers_give_what_one_process_gives(toile: Toile, tmp_path: Path, launcher: str) -> None:
    pytest.importorskip(f"hydra_plugins.hydra_{launcher.partition('_')[0]}_launcher")
    assert toile("fit", *SHORT, "seed=1", "hydra.run.dir=alone").status == 0
    command = [sys.executable, "-m", "toile.cli.main", "fit", "-m", *SHORT, "seed=0,1"]
    command += [f"hydra/launcher={launcher}", "hydra.sweep.dir=sweep"]
    environment = os.environ | {"RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0"}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "2 of 2 runs in sweep have a result" in done.stderr
    alone, launched = (read_trajectory(RunFolder(tmp_path / p)) for p in ("alone", "sweep/1_swaying"))
    np.testing.assert_array_equal(alone.positions, launched.positions)


def test_optuna_searches_and_goes_on_with_its_study(toile: Toile, tmp_path: Path) -> None:
    pytest.importorskip("hydra_plugins.hydra_optuna_sweeper")
    search = ("fit", "-m", "experiment=search", *QUICK, "optimization.stages.calibrate=null")
    # In a process of its own: Optuna 2 and its database warn about themselves.
    for trials in (1, 2):
        command = [sys.executable, "-m", "toile.cli.main", *search, "hydra.sweeper.n_trials=1"]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        assert f"{trials} of {trials} runs in outputs/search/swaying have a result" in done.stderr
    results = (tmp_path / "outputs/search/swaying/optimization_results.yaml").read_text()
    assert "optimization.stages.track.priors.turbulence" in results
