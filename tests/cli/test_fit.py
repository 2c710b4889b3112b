"""``toile fit`` from the command line to the run folder."""

from __future__ import annotations

import dataclasses
import json
import shutil
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch

from toile.cli.fit_tries import SECOND_TRY
from toile.learning.fit.module import FitModule
from toile.reconstruction.lost_cloth import LostClothGuard
from toile.reports.run_folder import RunFolder, read_history, read_metrics, read_trajectory
from toile.scenes.native import write_native
from toile.scenes.scene import Scene

Toile = Callable[..., Any]
PAPER = (
    "fit",
    "scene=swaying",
    "experiment=paper",
    "optimization.cycles=6",
    "optimization.first_frames=3",
    "optimization.cycles_per_frame=1",
    "callbacks.checkpoint.every=2",
)
QUICK = ("logger=none", "report.video=false", "report.page=false")


@pytest.fixture
def swaying(swaying_scene: Scene, tmp_path: Path) -> Path:
    """The scene "swaying" in the data folder."""
    return write_native(swaying_scene, tmp_path / "data" / "made" / "swaying")


def identical(a: RunFolder, b: RunFolder) -> bool:
    first, second = read_trajectory(a), read_trajectory(b)
    assert first.parameters.keys() == second.parameters.keys()
    same = [np.array_equal(v, second.parameters[k]) for k, v in first.parameters.items()]
    return np.array_equal(first.positions, second.positions) and all(same)


def interrupt_at(n: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C in cycle n."""
    step = FitModule.training_step

    def interrupted(self: FitModule, batch: int, batch_idx: int) -> None:
        if self.cycles_done == n:
            raise KeyboardInterrupt
        step(self, batch, batch_idx)

    monkeypatch.setattr(FitModule, "training_step", interrupted)


@pytest.mark.usefixtures("swaying")
def test_a_run_folder_holds_everything(toile: Toile, tmp_path: Path) -> None:
    outcome = toile(*PAPER, "hydra.run.dir=run")
    assert outcome.status == 0, outcome.err
    assert "Silhouette IoU" in outcome.out
    assert str(tmp_path / "run" / "index.html") in outcome.out
    assert "GPU available" not in outcome.err
    run = RunFolder(tmp_path / "run")
    for path in (run.config, run.git_revision, run.history, run.page, run.overlay_video):
        assert path.stat().st_size > 0
    assert {p.name for p in run.figures.iterdir()} == {
        "errors.png",
        "losses.png",
        "parameters.png",
        "side_view.png",
    }
    assert list((run.path / "tensorboard").glob("events.out.tfevents.*"))
    metrics = read_metrics(run)
    assert metrics["metrics"]["chamfer"]["mean"] < 1.0
    assert metrics["metrics"]["silhouette_iou"]["mean"] > 0.98
    # Small only if internal, external and inertial forces have consistent signs and units.
    assert metrics["metrics"]["out_of_balance"]["mean"] < 0.3
    assert metrics["fit"]["cycles"] == 6
    assert 0 < metrics["fit"]["seconds of the fit"] < metrics["fit"]["seconds in total"]
    assert metrics["fit"]["processor seconds of the fit"] > 0
    assert metrics["machine"]["processors"] >= 1
    trajectory = read_trajectory(run)
    assert trajectory.positions.shape == (5, 8, 8, 3)
    assert trajectory.parameters["turbulence [m/s²]"].shape == (4, 8, 8, 3)
    history = read_history(run)
    assert history["cycle"].tolist() == list(range(6))
    assert history["frames"].tolist() == [3, 4, 5, 5, 5, 5]


@pytest.mark.usefixtures("swaying")
def test_default_optimisation(toile: Toile, tmp_path: Path) -> None:
    outcome = toile("fit", "scene=swaying", *QUICK, "hydra.run.dir=run")
    assert outcome.status == 0, outcome.err
    metrics = read_metrics(RunFolder(tmp_path / "run"))
    assert metrics["metrics"]["chamfer"]["mean"] < 1.0
    # The parameters alone reproduce the motion that the optimisation has seen.
    assert metrics["fit"]["difference to the last cycle [mm]"] < 0.01


@pytest.mark.usefixtures("swaying")
@pytest.mark.parametrize("simulator", ["surrogate", "hybrid"])
def test_other_simulators(simulator: str, toile: Toile, tmp_path: Path) -> None:
    outcome = toile("fit", "scene=swaying", f"simulator={simulator}", *QUICK, "hydra.run.dir=run")
    assert outcome.status == 0, outcome.err
    metrics = read_metrics(RunFolder(tmp_path / "run"))
    assert metrics["metrics"]["chamfer"]["mean"] < 1.0
    assert metrics["fit"]["difference to the last cycle [mm]"] < 0.01


def test_without_ground_truth(swaying_scene: Scene, toile: Toile, tmp_path: Path) -> None:
    write_native(
        dataclasses.replace(swaying_scene, ground_truth=None), tmp_path / "data" / "made" / "swaying"
    )
    outcome = toile(*PAPER, *QUICK, "hydra.run.dir=run")
    assert outcome.status == 0, outcome.err
    metrics = read_metrics(RunFolder(tmp_path / "run"))
    assert set(metrics["metrics"]) == {"silhouette_iou", "out_of_balance"}
    assert not (tmp_path / "run" / "overlay.mp4").exists()


@pytest.mark.usefixtures("swaying")
def test_an_interrupted_fit_leaves_a_usable_folder_and_continues(
    toile: Toile, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert toile(*PAPER, *QUICK, "hydra.run.dir=whole").status == 0
    handler = signal.getsignal(signal.SIGINT)
    with monkeypatch.context() as patch:
        interrupt_at(3, patch)
        outcome = toile(*PAPER, *QUICK, "hydra.run.dir=run")
    assert outcome.status == 130
    assert "stopped after 3 of 6 cycles" in outcome.out
    assert signal.getsignal(signal.SIGINT) is handler
    run = RunFolder(tmp_path / "run")
    assert len(read_history(run)) == 3
    assert read_trajectory(run).positions.shape[0] == 5
    # Numbers and a page of what there is do not end it.
    assert toile("evaluate", "run=run").status == 0
    assert toile("report", "run").status == 0
    outcome = toile("fit", "resume=run")
    assert outcome.status == 0, outcome.err
    assert "continuing from" in outcome.err
    assert len(read_history(run)) == 6
    assert identical(run, RunFolder(tmp_path / "whole"))


@pytest.mark.usefixtures("swaying")
def test_the_default_optimisation_continues_bit_for_bit(
    toile: Toile, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    command = ("fit", "scene=swaying", *QUICK)
    assert toile(*command, "hydra.run.dir=whole").status == 0
    with monkeypatch.context() as patch:
        interrupt_at(2, patch)
        assert toile(*command, "hydra.run.dir=run").status == 130
    assert toile("fit", "resume=run").status == 0
    assert identical(RunFolder(tmp_path / "run"), RunFolder(tmp_path / "whole"))


@pytest.mark.usefixtures("swaying")
def test_the_same_command_continues_its_folder(
    toile: Toile, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        interrupt_at(3, patch)
        assert toile(*PAPER, *QUICK, "hydra.run.dir=run").status == 130
    shutil.copytree(tmp_path / "run", tmp_path / "copy")
    assert toile(*PAPER, *QUICK, "hydra.run.dir=run").status == 0
    # In another folder with other loggers and paths it is still the same fit.
    assert toile(*PAPER, *QUICK, "callbacks.progress=null", "hydra.run.dir=copy").status == 0
    assert identical(RunFolder(tmp_path / "run"), RunFolder(tmp_path / "copy"))
    outcome = toile(*PAPER, *QUICK, "loss.silhouette.sigma=5", "hydra.run.dir=run")
    assert outcome.status == 2
    assert "loss.silhouette.sigma: 5 instead of 7.0" in outcome.err


@pytest.mark.usefixtures("swaying")
def test_a_refused_resume_leaves_the_run_as_it_was(
    toile: Toile, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Hydra rewrites its own record before anybody can refuse; the run's stays."""
    assert toile(*PAPER, *QUICK, "hydra.run.dir=whole").status == 0
    with monkeypatch.context() as patch:
        interrupt_at(3, patch)
        assert toile(*PAPER, *QUICK, "hydra.run.dir=run").status == 130
    refused = toile("fit", "resume=run", "seed=4")
    assert refused.status == 2
    assert "seed: 4 instead of 0" in refused.err
    # The same in its own words.
    assert toile(*PAPER, *QUICK, "seed=5", "hydra.run.dir=run").status == 2
    # One that was interrupted before it had a record of its own.
    shutil.copytree(tmp_path / "run", tmp_path / "old")
    outcome = toile("fit", "resume=run")
    assert outcome.status == 0, outcome.err
    assert identical(RunFolder(tmp_path / "run"), RunFolder(tmp_path / "whole"))


@pytest.mark.usefixtures("swaying")
def test_runs_of_older_versions_are_continued_from_hydras_record(
    toile: Toile, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        interrupt_at(3, patch)
        assert toile(*PAPER, *QUICK, "hydra.run.dir=run").status == 130
    RunFolder(tmp_path / "run").overrides.unlink()
    assert toile("fit", "resume=run").status == 0


@pytest.mark.usefixtures("swaying")
def test_stopped_before_the_first_cycle_there_is_nothing_to_continue(
    toile: Toile, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        interrupt_at(0, patch)
        outcome = toile(*PAPER, *QUICK, "hydra.run.dir=run")
    assert outcome.status == 130
    assert "nothing to continue" in outcome.out
    assert "resume=" not in outcome.out
    assert not RunFolder(tmp_path / "run").trajectory.exists()
    assert toile(*PAPER, *QUICK, "hydra.run.dir=run").status == 0


def test_warnings_of_the_scene_are_said(
    swaying_scene: Scene, toile: Toile, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On the console, in the log, and with the numbers that the page shows."""
    heavy = dataclasses.replace(swaying_scene, gravity=1.3 * swaying_scene.gravity)
    write_native(heavy, tmp_path / "data" / "made" / "heavy")
    outcome = toile(*PAPER, *QUICK, "scene=heavy", "hydra.run.dir=run")
    assert outcome.status == 0
    warning = "Gravity has an unusual magnitude"
    run = RunFolder(tmp_path / "run")
    assert warning in outcome.err
    assert warning in (run.path / "fit.log").read_text()
    assert any(warning in text for text in read_metrics(run)["scene warnings"])


def test_an_impossible_scene_stops_the_fit_unless_forced(
    swaying_scene: Scene, toile: Toile, tmp_path: Path
) -> None:
    strong = dataclasses.replace(swaying_scene, gravity=4 * swaying_scene.gravity)
    write_native(strong, tmp_path / "data" / "made" / "strong")
    command = (*PAPER, *QUICK, "scene=strong", "optimization.cycles=1", "hydra.run.dir=run")
    refused = toile(*command)
    assert refused.status == 2
    assert "Gravity is far too strong" in refused.err
    assert "force=true" in refused.err
    assert not RunFolder(tmp_path / "run").trajectory.exists()
    forced = toile(*command, "force=true")
    assert forced.status == 0
    assert any(
        "far too strong" in text for text in read_metrics(RunFolder(tmp_path / "run"))["scene warnings"]
    )


def test_one_frame_cannot_be_fitted(swaying: Path, toile: Toile) -> None:
    refused = toile("fit", "scene=swaying", "scene.n_frames=1", "force=true", "hydra.run.dir=run")
    assert refused.status == 2
    assert "Too few frames for a fit" in refused.err
    assert swaying.is_dir()


def lose_the_cloth(monkeypatch: pytest.MonkeyPatch, *kept: int) -> None:
    """Let the outline say so, once for each try."""
    answers = iter(kept)
    monkeypatch.setattr(LostClothGuard, "first_lost", lambda *_: next(answers))


@pytest.mark.usefixtures("swaying")
def test_where_the_cloth_is_lost_a_second_try_follows_the_outline_more(
    toile: Toile, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    command = ("fit", "scene=swaying", *QUICK)
    assert toile(*command, "hydra.run.dir=usual").status == 0
    usual = RunFolder(tmp_path / "usual")
    (few_frames,) = read_metrics(usual)["scene warnings"]
    with monkeypatch.context() as patch:
        lose_the_cloth(patch, 2, 5)
        outcome = toile(*command, "hydra.run.dir=run")
    assert outcome.status == 0
    assert "second try, silhouette 10 times heavier" in outcome.err
    run = RunFolder(tmp_path / "run")
    assert not identical(run, usual)
    assert any("first try lost the cloth in frame 2" in w for w in read_metrics(run)["scene warnings"])
    assert (run.path / SECOND_TRY / "checkpoints").is_dir()
    # Kept no longer: the first try counts, and what is lost is said.
    with monkeypatch.context() as patch:
        lose_the_cloth(patch, 2, 2)
        assert toile(*command, "hydra.run.dir=lost").status == 0
    lost = RunFolder(tmp_path / "lost")
    assert identical(lost, usual)
    assert few_frames in read_metrics(lost)["scene warnings"]
    assert any("lost from frame 2 on" in w for w in read_metrics(lost)["scene warnings"])
    # Nothing but said.
    with monkeypatch.context() as patch:
        lose_the_cloth(patch, 2)
        assert toile(*command, "lost_cloth.mask_factor=null", "hydra.run.dir=said").status == 0
    assert not (tmp_path / "said" / SECOND_TRY).exists()


@pytest.mark.usefixtures("swaying")
def test_a_second_try_continues_bit_for_bit(
    toile: Toile, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    command = ("fit", "scene=swaying", *QUICK)
    with monkeypatch.context() as patch:
        lose_the_cloth(patch, 2, 5)
        assert toile(*command, "hydra.run.dir=whole").status == 0
    step = FitModule.training_step
    calls: list[int] = []

    def interrupted(self: FitModule, batch: int, batch_idx: int) -> None:
        calls.append(self.cycles_done)
        if calls.count(0) == 2 and self.cycles_done == 2:
            raise KeyboardInterrupt
        step(self, batch, batch_idx)

    with monkeypatch.context() as patch:
        lose_the_cloth(patch, 2, 5)
        patch.setattr(FitModule, "training_step", interrupted)
        outcome = toile(*command, "hydra.run.dir=run")
    assert outcome.status == 130
    assert "second try stopped" in outcome.out
    with monkeypatch.context() as patch:
        lose_the_cloth(patch, 2, 5)
        assert toile("fit", "resume=run").status == 0
    assert identical(RunFolder(tmp_path / "run"), RunFolder(tmp_path / "whole"))


def test_nothing_to_resume(toile: Toile) -> None:
    outcome = toile("fit", "resume=nowhere")
    assert outcome.status == 2
    assert "There is no fit to continue" in outcome.err


@pytest.mark.usefixtures("swaying")
def test_terms_that_would_be_ignored_are_refused(toile: Toile) -> None:
    outcome = toile("fit", "scene=swaying", "loss=paper")
    assert outcome.status == 2
    assert "The optimisation has terms of its own" in outcome.err


@pytest.mark.usefixtures("swaying")
def test_ablation_on_the_command_line(toile: Toile, tmp_path: Path) -> None:
    outcome = toile(*PAPER, *QUICK, "ablation=no_turbulence", "hydra.run.dir=run")
    assert outcome.status == 0, outcome.err
    trajectory = read_trajectory(RunFolder(tmp_path / "run"))
    assert not trajectory.parameters["turbulence [m/s²]"].any()
    assert trajectory.parameters["texture offset"].any()
    history = pd.read_csv(tmp_path / "run" / "history.csv")
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["fit"]["cycles"] == len(history)


EFFECT = ("fit", "scene=swaying", "effect=[air_drag,gusts]", "fixed_effects=[gusts]", *QUICK)


@pytest.mark.usefixtures("swaying")
def test_a_fit_with_effects(toile: Toile, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    outcome = toile(*EFFECT, "effect.gusts.values.x_1=0.2", "hydra.run.dir=run")
    assert outcome.status == 0, outcome.err
    run = RunFolder(tmp_path / "run")
    metrics = read_metrics(run)
    assert metrics["metrics"]["chamfer"]["mean"] < 1.0
    # The parameters alone, effects among them, reproduce the motion that the optimisation has seen.
    assert metrics["fit"]["difference to the last cycle [mm]"] < 0.01
    fitted = read_trajectory(run).parameters
    assert fitted["air_drag normal [1/s]"] > 0
    assert fitted["gusts x_1 [m/s²]"] == 0.2
    assert "air_drag normal [1/s]" in read_history(run)
    assert "gusts x_1 [m/s²]" not in read_history(run)
    # No page was asked for; it can be had later.
    assert not run.page.exists()
    assert not any(run.figures.iterdir())
    assert "finished before" in toile(*EFFECT, "effect.gusts.values.x_1=0.2", "hydra.run.dir=run").out
    assert toile("report", "run").status == 0
    page = run.page.read_text(encoding="utf-8")
    assert "air_drag normal" in page
    with monkeypatch.context() as patch:
        interrupt_at(2, patch)
        assert toile(*EFFECT, "effect.gusts.values.x_1=0.2", "hydra.run.dir=again").status == 130
    assert toile("fit", "resume=again").status == 0
    assert identical(RunFolder(tmp_path / "again"), run)


@pytest.mark.usefixtures("swaying")
def test_an_identification_with_an_effect(toile: Toile, tmp_path: Path) -> None:
    outcome = toile(
        "fit", "scene=swaying", "optimization=identification", "effect=air_drag", *QUICK, "hydra.run.dir=run"
    )
    assert outcome.status == 0, outcome.err
    run = RunFolder(tmp_path / "run")
    assert read_metrics(run)["fit"]["difference to the last cycle [mm]"] < 0.01
    assert not read_trajectory(run).parameters["turbulence [m/s²]"].any()


@pytest.mark.usefixtures("swaying")
def test_effects_of_the_image_are_refused(toile: Toile) -> None:
    outcome = toile("fit", "scene=swaying", "effect=[air_drag,shading]")
    assert outcome.status == 2
    assert "A fit takes effects on the motion" in outcome.err
    assert "air_drag" in outcome.err


def test_unevenly_spaced_frames_from_the_fit_to_the_export(
    swaying_scene: Scene, toile: Toile, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The swaying cloth without its third frame: 20, 40 and 20 ms."""
    chosen = [0, 1, 3, 4]
    times = torch.tensor([0.0, 0.02, 0.06, 0.08], dtype=torch.float64)
    assert swaying_scene.ground_truth is not None
    assert swaying_scene.ground_truth.vertices is not None
    truth = dataclasses.replace(
        swaying_scene.ground_truth,
        vertices=swaying_scene.ground_truth.vertices[chosen],
        point_clouds=tuple((swaying_scene.ground_truth.point_clouds or ())[k] for k in chosen)
        if swaying_scene.ground_truth.point_clouds
        else None,
    )
    scene = dataclasses.replace(
        swaying_scene,
        frames=swaying_scene.frames[chosen],
        masks=swaying_scene.masks[chosen],
        times=times,
        fps=3 / 0.08,
        ground_truth=truth,
    )
    write_native(scene, tmp_path / "data" / "made" / "swaying")
    fit = ("fit", "scene=swaying", *QUICK)
    assert toile(*fit, "hydra.run.dir=whole").status == 0
    whole = RunFolder(tmp_path / "whole")
    metrics = read_metrics(whole)
    assert metrics["metrics"]["chamfer"]["mean"] < 1.0
    assert metrics["fit"]["difference to the last cycle [mm]"] < 0.01
    saved = read_trajectory(whole)
    assert saved.times is not None
    assert saved.times.tolist() == times.tolist()
    assert toile("report", "whole").status == 0
    assert "37.5 per second on average" in whole.page.read_text()
    # Interrupted and continued, it is the same.
    with monkeypatch.context() as patch:
        interrupt_at(2, patch)
        assert toile(*fit, "callbacks.checkpoint.every=1", "hydra.run.dir=run").status == 130
    assert toile("fit", "resume=run").status == 0
    assert identical(whole, RunFolder(tmp_path / "run"))
    assert toile("export", "run=whole", "format=usd", "folder=out").status == 0
    # What counts frames as time says so.
    status, _, err = toile("fit", "scene=swaying", "simulator.substeps=2", *QUICK, "hydra.run.dir=fixed")
    assert status == 2
    assert "evenly spaced frames" in err
    status, _, err = toile("diagnose", "scene=swaying", "hydra.run.dir=diagnosis")
    assert status == 2
    assert "times=uniform" in err
