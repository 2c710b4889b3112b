"""A training in Lightning: what it does, and that it continues bit for bit."""

from __future__ import annotations

import math
import os
import re
import signal
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning import Callback, Trainer
from lightning.pytorch.strategies import DDPStrategy
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.custom_scalar.layout_pb2 import Layout

from toile.errors import InputError
from toile.learning.checkpoints import LAST
from toile.learning.last_checkpoint import LastCheckpoint
from toile.learning.quiet import quiet_lightning
from toile.learning.surrogate.average import AverageSurrogate
from toile.learning.surrogate.batches import PoolBatches
from toile.learning.surrogate.callbacks.epoch_weights import EpochWeights
from toile.learning.surrogate.callbacks.progress import EpochLines
from toile.learning.surrogate.callbacks.stopping import StopBetweenSteps
from toile.learning.surrogate.callbacks.tensorboard import DashboardLayout, PictureLogger
from toile.learning.surrogate.emphasis import Emphasis
from toile.learning.surrogate.module import SurrogateTraining
from toile.learning.surrogate.objectives import BehindTheSweeps
from toile.learning.surrogate.resets import ResetRules
from toile.learning.surrogate.schedules import RolloutLength, StiffnessShare, UnrolledSteps
from toile.physics.surrogate.surrogate import Surrogate
from toile.physics.surrogate.weights import load_weights

MakeTraining = Callable[..., SurrogateTraining]


class StoppedError(Exception):
    """Stands for anything that ends a training in the middle of a step."""


class Crash(Callback):
    """Ends a training before step n."""

    def __init__(self, n: int) -> None:
        self.n = n

    def on_train_batch_start(self, trainer: Any, pl_module: Any, batch: Any, batch_idx: int) -> None:
        if pl_module.steps_done == self.n:
            raise StoppedError


class Interrupt(Crash):
    """Presses Ctrl-C in step n."""

    def on_train_batch_start(self, trainer: Any, pl_module: Any, batch: Any, batch_idx: int) -> None:
        if pl_module.steps_done == self.n:
            signal.raise_signal(signal.SIGINT)


class InterruptFirst(Interrupt):
    """Presses Ctrl-C in step n, in one process only."""

    def on_train_batch_start(self, trainer: Any, pl_module: Any, batch: Any, batch_idx: int) -> None:
        if trainer.is_global_zero:
            super().on_train_batch_start(trainer, pl_module, batch, batch_idx)


def train(
    module: SurrogateTraining,
    *callbacks: Callback,
    checkpoint: Path | None = None,
    seed: int = 0,
    **trainer: Any,
) -> SurrogateTraining:
    """Train; the module is left with the averaged network, which is what a training gives."""
    quiet_lightning()
    settings = {
        "accelerator": "cpu",
        "devices": 1,
        "max_epochs": module.settings.epochs,
        "num_sanity_val_steps": 0,
        "enable_checkpointing": any(isinstance(c, LastCheckpoint) for c in callbacks),
        "enable_progress_bar": False,
        "enable_model_summary": False,
        "logger": False,
        "log_every_n_steps": 1,
    }
    average = AverageSurrogate(module.settings.average_decay)
    Trainer(**{**settings, **trainer}, callbacks=[average, *callbacks]).fit(
        module, datamodule=PoolBatches(module.settings, seed), ckpt_path=checkpoint, weights_only=True
    )
    if "strategy" not in trainer:  # other processes keep theirs to themselves
        module.surrogate = average.surrogate
    return module


def without_times(history: list[dict[str, float]]) -> list[dict[str, float]]:
    return [{k: v for k, v in row.items() if k != "seconds"} for row in history]


def assert_identical(a: SurrogateTraining, b: SurrogateTraining) -> None:
    for name, value in a.state_dict().items():
        assert torch.equal(value, b.state_dict()[name]), name
    for name, tensor in a.pool.states.tensors().items():
        assert torch.equal(tensor, b.pool.states.tensors()[name]), name
    assert torch.equal(a.pool.generator.get_state(), b.pool.generator.get_state())
    assert without_times(a.history) == without_times(b.history)


def test_a_training_changes_weights_average_and_pool(make_training: MakeTraining, tmp_path: Path) -> None:
    module = make_training()
    before = {name: value.clone() for name, value in module.surrogate.state_dict().items()}
    train(module, saving := LastCheckpoint(tmp_path, every=100, save_on_exception=False))
    assert module.finished
    assert module.steps_done == 9
    average = module.surrogate.state_dict()
    last = torch.load(saving.path, weights_only=True)["current_model_state"]
    now = {name: last[f"surrogate.{name}"] for name in before}
    assert any(not torch.equal(before[name], now[name]) for name in before)
    assert any(not torch.equal(average[name], now[name]) for name in before)
    assert any(not torch.equal(average[name], before[name]) for name in before)
    assert module.pool.states.age.max() > 0
    assert [row["steps"] for row in module.history] == [3, 6, 9]
    row = module.history[-1]
    assert all(math.isfinite(value) for value in row.values())
    assert {"pass 2/residual 0.9", "energy/bending", "resets/old", "validation residual/median"} <= row.keys()
    assert module.validation is not None
    assert module.validation.shape == (2, 3)


def test_a_cloth_gets_no_older_than_the_rollout(make_training: MakeTraining) -> None:
    class Ages(Callback):
        def on_train_batch_end(self, trainer: Any, pl_module: Any, *_: Any) -> None:
            length = pl_module.settings.rollout_length.at(pl_module.steps_done - 1, 9)
            assert pl_module.pool.states.age.max() < length

    module = train(make_training(rollout_length=RolloutLength(2, 3, 1.0)), Ages())
    assert sum(row["resets/old"] for row in module.history) > 0


def test_what_cannot_be_solved_is_reset(make_training: MakeTraining) -> None:
    module = train(make_training(resets=ResetRules(0.0, 0.0, 200.0, 0.0), rollout_length=None))
    assert module.pool.states.age.max() == 0
    assert module.history[0]["resets/diverged"] == 4


def test_a_gradient_that_is_not_finite_is_left_out(
    make_training: MakeTraining, monkeypatch: pytest.MonkeyPatch
) -> None:
    passes = Surrogate.passes

    def spoilt(self: Surrogate, problem: Any, n_passes: int) -> Any:
        for result in passes(self, problem, n_passes):
            yield replace(result, gradient=result.gradient * torch.nan)

    module = make_training()
    before = {name: value.clone() for name, value in module.surrogate.state_dict().items()}
    with monkeypatch.context() as patch:
        patch.setattr(Surrogate, "passes", spoilt)
        train(module)
    assert all(torch.equal(before[name], v) for name, v in module.surrogate.state_dict().items())
    assert module.history[-1]["skipped steps"] == 1


def test_a_repeated_training_is_bit_identical(make_training: MakeTraining) -> None:
    assert_identical(train(make_training()), train(make_training()))


@pytest.mark.parametrize("stop", [1, 3, 4])
def test_an_interrupted_training_continues_bit_for_bit(
    stop: int, make_training: MakeTraining, tmp_path: Path
) -> None:
    whole = train(make_training())
    handler = signal.getsignal(signal.SIGINT)
    stopping, saving = StopBetweenSteps(None), LastCheckpoint(tmp_path, every=100, save_on_exception=False)
    half = train(make_training(), Interrupt(stop - 1), stopping, saving)
    assert stopping.interrupted
    assert half.steps_done == stop
    assert signal.getsignal(signal.SIGINT) is handler
    resumed = train(make_training(seed=5), seed=5, checkpoint=saving.path)
    assert resumed.steps_done == 9
    assert_identical(resumed, whole)


def test_a_training_behind_the_sweeps_continues_bit_for_bit(
    make_training: MakeTraining, tmp_path: Path
) -> None:
    changes: dict[str, Any] = {
        "objective": BehindTheSweeps(1, UnrolledSteps((0.5,))),
        "stiffness_share": StiffnessShare(0.5, 0.8),
        "pool": replace(
            make_training().settings.pool,
            calm_share=0.5,
            emphasis=Emphasis(2, corners=0.3, evenly=0.5, memory=0.9),
        ),
    }
    whole = train(make_training(**changes), EpochWeights(tmp_path / "epochs"))
    assert whole.pool.share == 1.0
    assert whole.pool.states.turbulence_strength.eq(0).any()
    saving = LastCheckpoint(tmp_path, every=100, save_on_exception=False)
    train(make_training(**changes), Interrupt(3), StopBetweenSteps(None), saving)
    resumed = train(make_training(seed=5, **changes), seed=5, checkpoint=saving.path)
    assert_identical(resumed, whole)
    assert whole.pool.failures is not None
    assert resumed.pool.failures is not None
    assert whole.pool.failures.min() < 1
    assert torch.equal(resumed.pool.failures, whole.pool.failures)
    files = sorted((tmp_path / "epochs").iterdir())
    assert [file.name for file in files] == ["epoch_001.pt", "epoch_002.pt", "epoch_003.pt"]
    last = load_weights(files[-1]).state_dict()
    assert all(torch.equal(value, last[name]) for name, value in whole.surrogate.state_dict().items())


@pytest.mark.parametrize(("every", "crash", "kept"), [(2, 5, 4), (1, 3, 3), (1, 7, 7), (5, 8, 6)])
def test_a_crash_continues_from_the_last_checkpoint(
    every: int, crash: int, kept: int, make_training: MakeTraining, tmp_path: Path
) -> None:
    whole, saving = train(make_training()), LastCheckpoint(tmp_path, every, save_on_exception=False)
    with pytest.raises(StoppedError):
        train(make_training(), StopBetweenSteps(None), saving, Crash(crash))
    assert torch.load(saving.path, weights_only=True)["global_step"] == kept
    assert_identical(train(make_training(), checkpoint=saving.path), whole)


def test_time_counts_over_resumes(make_training: MakeTraining, tmp_path: Path) -> None:
    saving, stopping = LastCheckpoint(tmp_path, every=100, save_on_exception=False), StopBetweenSteps(0.0)
    first = train(make_training(), stopping, saving)
    assert (first.steps_done, stopping.out_of_time, stopping.interrupted) == (1, True, False)
    second = train(make_training(), StopBetweenSteps(0.0), saving, checkpoint=saving.path)
    assert second.steps_done == 2
    assert second.seconds > first.seconds > 0


def test_continuing_a_finished_training_changes_nothing(make_training: MakeTraining, tmp_path: Path) -> None:
    saving = LastCheckpoint(tmp_path, every=100, save_on_exception=False)
    whole = train(make_training(), saving)
    assert [path.name for path in tmp_path.iterdir()] == ["last.ckpt"]
    assert_identical(train(make_training(), checkpoint=saving.path), whole)


def test_bfloat16_leaves_positions_alone(make_training: MakeTraining) -> None:
    module = train(make_training(), precision="bf16-mixed")
    assert module.pool.states.history.dtype == torch.float64
    assert all(p.dtype == torch.float32 for p in module.surrogate.parameters())
    assert all(math.isfinite(value) for value in module.history[-1].values())


def test_tensorboard_and_lines(
    make_training: MakeTraining, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    from lightning.pytorch.loggers import TensorBoardLogger

    logger = TensorBoardLogger(tmp_path, name="", version="")
    with caplog.at_level("INFO", logger="toile"):
        train(
            make_training(),
            DashboardLayout(),
            PictureLogger(2),
            EpochLines(),
            logger=logger,
            log_every_n_steps=2,
        )
    lines = [r.message.split(":")[0] for r in caplog.records]
    assert lines == [f"epoch {k} of 3" for k in (1, 2, 3)]
    events = EventAccumulator(str(tmp_path))
    events.Reload()
    config = events.Tensors("custom_scalars__config__")[0].tensor_proto.string_val[0]
    charts = [chart for group in Layout.FromString(config).category for chart in group.chart]
    assert len(charts) == 9
    for chart in charts:
        found = [tag for tag in events.Tags()["scalars"] if re.match(chart.multiline.tag[0], tag)]
        assert found, chart.title
    tags = events.Tags()
    assert {"step/pass_1/accepted", "step/learning_rate", "epoch/energy/stretching"} <= set(tags["scalars"])
    assert [e.step for e in events.Scalars("step/learning_rate")] == [2, 4, 6, 8]
    assert [e.step for e in events.Images("pool")] == [3, 6, 9]
    assert "validation rollout" in tags["images"]


@pytest.mark.parametrize(
    ("setting", "value"),
    [("max_epochs", 1), ("max_steps", 5), ("accumulate_grad_batches", 2), ("gradient_clip_val", 0.5)],
)
def test_the_trainer_must_not_change_what_is_counted(
    setting: str, value: float, make_training: MakeTraining
) -> None:
    with pytest.raises(InputError, match=f"trainer.{setting}"):
        train(make_training(), **{setting: value})


def test_a_batch_must_fit_into_the_pool(make_training: MakeTraining) -> None:
    with pytest.raises(InputError, match=r"training\.batch_size"):
        make_training(batch_size=9)


class KeepResults(Callback):
    """Stores what a process of a parallel training ends with."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def on_train_end(self, trainer: Any, pl_module: Any) -> None:
        result = {"weights": pl_module.surrogate.state_dict(), "pool": pl_module.pool.state_dict()}
        torch.save(result, self.folder / f"{pl_module.global_rank}.pt")


@pytest.mark.skipif(not hasattr(os, "fork"), reason="starts the processes by forking")
def test_two_processes_share_weights_but_no_cloths(make_training: MakeTraining, tmp_path: Path) -> None:
    saving = LastCheckpoint(tmp_path / "checkpoint", every=100, save_on_exception=False)
    strategy = DDPStrategy(start_method="fork", process_group_backend="gloo")
    module = make_training(epochs=1, steps_per_epoch=2, batch_size=4)
    train(module, saving, KeepResults(tmp_path), devices=2, strategy=strategy)
    a, b = (torch.load(tmp_path / f"{rank}.pt", weights_only=True) for rank in (0, 1))
    for name, value in a["weights"].items():
        assert torch.equal(value, b["weights"][name]), name
    assert len(a["pool"]["states"]["age"]) == 4
    assert not torch.equal(a["pool"]["states"]["stiffness"], b["pool"]["states"]["stiffness"])
    stored_pools = torch.load(saving.path, weights_only=True)["PoolBatches"]["pools"]
    assert len(stored_pools) == 2
    for stored, result in zip(stored_pools, (a, b), strict=True):
        assert torch.equal(stored["states"]["history"], result["pool"]["states"]["history"])


@pytest.mark.skipif(not hasattr(os, "fork"), reason="starts the processes by forking")
def test_two_processes_stop_together_and_continue_bit_for_bit(
    make_training: MakeTraining, tmp_path: Path
) -> None:
    def run(folder: str, *callbacks: Callback, checkpoint: Path | None = None) -> dict[str, Any]:
        saving = LastCheckpoint(tmp_path / folder, every=100, save_on_exception=False)
        strategy = DDPStrategy(start_method="fork", process_group_backend="gloo")
        module = make_training(epochs=2, steps_per_epoch=2)
        train(module, *callbacks, saving, checkpoint=checkpoint, devices=2, strategy=strategy)
        stored: dict[str, Any] = torch.load(saving.path, weights_only=True)
        return stored

    whole = run("whole")
    half = run("half", InterruptFirst(1), StopBetweenSteps(None))
    assert half["global_step"] == 2
    resumed = run("half", checkpoint=tmp_path / "half" / LAST)
    assert resumed["global_step"] == 4
    for name, value in whole["state_dict"].items():
        assert torch.equal(value, resumed["state_dict"][name]), name
    for a, b in zip(whole["PoolBatches"]["pools"], resumed["PoolBatches"]["pools"], strict=True):
        for name, tensor in a["states"].items():
            assert torch.equal(tensor, b["states"][name]), name
