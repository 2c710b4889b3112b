"""The one checkpoint of fits and trainings: when it is written, and that it is never half written."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint
from omegaconf import OmegaConf

from toile.cli.trainer import make_trainer
from toile.learning.last_checkpoint import LastCheckpoint
from toile.learning.quiet import quiet_lightning

TRAINER = OmegaConf.create(
    {
        "_target_": "lightning.Trainer",
        "_partial_": True,
        "accelerator": "cpu",
        "max_epochs": 2,
        "enable_progress_bar": False,
        "enable_model_summary": False,
    }
)


class Line(LightningModule):
    """Goes down a slope."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(()))

    def training_step(self, batch: int, batch_idx: int) -> torch.Tensor:
        return -self.weight

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.SGD(self.parameters(), lr=1.0)

    def train_dataloader(self) -> range:
        return range(4)


class Then(Callback):
    """Does something after a step."""

    def __init__(self, step: int, action: Any) -> None:
        self.step, self.action = step, action

    def on_train_batch_end(self, trainer: Trainer, *_: Any) -> None:
        if trainer.global_step == self.step:
            self.action(trainer)


def run(*callbacks: Callback) -> Trainer:
    quiet_lightning()
    trainer = make_trainer(TRAINER, callbacks, False)
    trainer.fit(Line())
    return trainer


def saved(path: Path) -> float:
    weight: torch.Tensor = torch.load(path, weights_only=True)["state_dict"]["weight"]
    return weight.item()


def fail(trainer: Trainer) -> None:
    raise ArithmeticError


def stop(trainer: Trainer) -> None:
    trainer.should_stop = True


def test_only_with_a_callback_that_writes_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert not run().checkpoint_callbacks
    assert not list(tmp_path.iterdir())
    trainer = run(LastCheckpoint(tmp_path / "checkpoints", every=3, save_on_exception=False), Then(99, fail))
    assert isinstance(trainer.callbacks[-1], ModelCheckpoint)  # type: ignore[attr-defined]
    assert [path.name for path in tmp_path.rglob("*.ckpt")] == ["last.ckpt"]


def test_every_few_steps_and_at_the_end_of_epochs(tmp_path: Path) -> None:
    saving, seen = LastCheckpoint(tmp_path, every=3, save_on_exception=False), []
    save = saving._save_checkpoint
    saving._save_checkpoint = lambda t, path: (seen.append(t.global_step), save(t, path))  # type: ignore[method-assign, assignment]
    run(saving)
    assert seen == [3, 4, 6, 8]


@pytest.mark.parametrize("step", [2, 4, 5])
def test_a_stop_saves_where_it_stops(step: int, tmp_path: Path) -> None:
    saving = LastCheckpoint(tmp_path, every=100, save_on_exception=False)
    run(saving, Then(step, stop))
    assert saved(saving.path) == step


@pytest.mark.parametrize(("on_exception", "step"), [(True, 7), (False, 6)])
def test_a_failure_saves_where_that_is_asked_for(on_exception: bool, step: int, tmp_path: Path) -> None:
    saving = LastCheckpoint(tmp_path, every=3, save_on_exception=on_exception)
    with pytest.raises(ArithmeticError):
        run(saving, Then(7, fail))
    assert saved(saving.path) == step


def test_a_failure_before_the_first_step_writes_nothing(tmp_path: Path) -> None:
    class Early(Callback):
        def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
            raise ArithmeticError

    with pytest.raises(ArithmeticError):
        run(LastCheckpoint(tmp_path, every=1, save_on_exception=True), Early())
    assert not list(tmp_path.iterdir())


def test_a_failure_while_writing_leaves_the_one_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    saving, write = LastCheckpoint(tmp_path, every=1, save_on_exception=False), Trainer.save_checkpoint

    def torn(self: Trainer, filepath: Path, *rest: Any) -> None:
        write(self, filepath, *rest)
        if self.global_step == 3:
            Path(filepath).write_bytes(b"half a")
            raise ArithmeticError

    monkeypatch.setattr(Trainer, "save_checkpoint", torn)
    with pytest.raises(ArithmeticError):
        run(saving)
    assert saved(saving.path) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["last.ckpt"]


def test_at_least_one_step_lies_between_two(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="at least 1 step"):
        LastCheckpoint(tmp_path, every=0, save_on_exception=False)
