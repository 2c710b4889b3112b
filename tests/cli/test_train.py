"""``toile train`` from the command line to the weights."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

from toile.cli.resume import checkpoint_path
from toile.learning.checkpoints import LAST
from toile.learning.surrogate.module import SurrogateTraining
from toile.physics.surrogate.weights import describe_weights, load_weights
from toile.reports.run_folder import RunFolder, read_history, read_metrics

Toile = Callable[..., Any]
TINY = ("train", "training=tiny", "threads=1")
QUICK = (*TINY, "logger=none")


def interrupt_in(step: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C in a step."""
    training_step = SurrogateTraining.training_step

    def interrupted(self: SurrogateTraining, batch: torch.Tensor, batch_idx: int) -> torch.Tensor:
        if self.steps_done == step:
            signal.raise_signal(signal.SIGINT)
        return training_step(self, batch, batch_idx)

    monkeypatch.setattr(SurrogateTraining, "training_step", interrupted)


def identical(a: Path, b: Path) -> bool:
    first, second = (load_weights(folder / "surrogate.pt").state_dict() for folder in (a, b))
    return all(torch.equal(value, second[name]) for name, value in first.items())


def test_a_run_folder_holds_everything(toile: Toile, tmp_path: Path) -> None:
    outcome = toile(*TINY, "hydra.run.dir=run")
    assert outcome.status == 0, outcome.err
    assert str(tmp_path / "run" / "surrogate.pt") in outcome.out
    assert [line.split(":")[0] for line in outcome.err.splitlines()] == [f"epoch {k} of 3" for k in (1, 2, 3)]
    run = RunFolder(tmp_path / "run")
    for path in (run.config, run.git_revision, run.history, run.figures / "validation.png"):
        assert path.stat().st_size > 0
    assert list((run.path / "tensorboard").glob("events.out.tfevents.*"))
    assert read_history(run)["steps"].tolist() == [4, 8, 12]
    metrics = read_metrics(run)
    assert metrics["training"]["steps"] == 12
    assert metrics["training"]["last epoch"]["validation residual/median"] > 0
    assert list(load_weights(run.path / "surrogate.pt").network.widths) == [4, 8]
    assert describe_weights(run.path / "surrogate.pt")["command"] == "toile train training=tiny"
    assert checkpoint_path(run).is_file()


def test_folders_are_named_after_the_settings(toile: Toile, tmp_path: Path) -> None:
    assert toile(*QUICK, "training.epochs=1").status == 0
    assert len(list((tmp_path / "outputs" / "train" / "tiny").glob("*/surrogate.pt"))) == 1


def test_an_interrupted_training_leaves_weights_and_continues(
    toile: Toile, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert toile(*QUICK, "hydra.run.dir=whole").status == 0
    handler = signal.getsignal(signal.SIGINT)
    with monkeypatch.context() as patch:
        interrupt_in(4, patch)
        outcome = toile(*QUICK, "hydra.run.dir=run")
    assert outcome.status == 130
    assert "stopped after 5 of 12 steps" in outcome.out
    assert signal.getsignal(signal.SIGINT) is handler
    assert not identical(tmp_path / "run", tmp_path / "whole")
    # Hydra notes what was refused; the run has a record of its own.
    assert toile("train", "resume=run", "seed=5").status == 2
    outcome = toile("train", "resume=run")
    assert outcome.status == 0, outcome.err
    assert "continuing from" in outcome.err
    assert identical(tmp_path / "run", tmp_path / "whole")
    assert len(read_history(RunFolder(tmp_path / "run"))) == 3


def test_time_runs_out_and_more_is_given(toile: Toile, tmp_path: Path) -> None:
    assert toile(*QUICK, "hydra.run.dir=whole").status == 0
    outcome = toile(*QUICK, "max_minutes=0", "hydra.run.dir=run")
    assert outcome.status == 0, outcome.err
    assert "stopped after 1 of 12 steps" in outcome.out
    # The same command with more time continues the folder.
    outcome = toile(*QUICK, "max_minutes=null", "hydra.run.dir=run")
    assert outcome.status == 0, outcome.err
    assert identical(tmp_path / "run", tmp_path / "whole")
    outcome = toile(*QUICK, "training.batch_size=3", "hydra.run.dir=run")
    assert outcome.status == 2
    assert "training.batch_size: 3 instead of 4" in outcome.err


def test_nothing_to_resume(toile: Toile) -> None:
    outcome = toile("train", "resume=nowhere")
    assert outcome.status == 2
    assert "There is no training to continue" in outcome.err


@pytest.mark.parametrize(
    ("setting", "named"),
    [
        ("training.batch_size=9", "training.batch_size"),
        ("training.pool.materials.shearing=[0,1]", "materials.shearing"),
        ("training.pool.pinned_corners.shares=[1,1,0,0]", "pinned_corners"),
        ("training.pool.grid=[2,7]", "3×3"),
        ("weights=nowhere.pt", "nowhere.pt"),
        ("weights=packaged", "training.widths"),
    ],
)
def test_unusable_settings(toile: Toile, setting: str, named: str) -> None:
    outcome = toile(*QUICK, setting, "hydra.run.dir=run")
    assert outcome.status == 2
    assert named in outcome.err


def test_two_processes(tmp_path: Path) -> None:
    """The real command: Lightning repeats it for the second process."""
    script = Path(sys.executable).with_name("toile")
    done = subprocess.run(
        [script, *QUICK, "training.epochs=1", "trainer=ddp", "trainer.accelerator=cpu", "hydra.run.dir=run"],
        cwd=tmp_path,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("epoch 1 of 1") == 1
    checkpoint = torch.load(tmp_path / "run" / "checkpoints" / LAST, weights_only=True)
    assert len(checkpoint["PoolBatches"]["pools"]) == 2
    overrides = yaml.safe_load((tmp_path / "run" / ".hydra" / "overrides.yaml").read_text())
    assert "trainer=ddp" in overrides
    assert load_weights(tmp_path / "run" / "surrogate.pt") is not None


def test_how_far_it_is_stands_in_the_log(toile: Toile, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("toile.progress.SECONDS_BETWEEN_LINES", 0.0)
    outcome = toile(*QUICK, "hydra.run.dir=run")
    steps = [line.split(",")[0] for line in outcome.err.splitlines() if line.startswith("step")]
    assert steps == [f"step: {k} of 12" for k in range(13)]
