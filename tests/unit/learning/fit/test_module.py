"""A fit in Lightning: history, checkpoints, and resuming bit for bit."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning import Callback, Trainer

from toile.learning.fit.callbacks.progress import FitProgress
from toile.learning.fit.module import PROCESSOR_SECONDS, CyclesOfFit, FitModule
from toile.learning.last_checkpoint import LastCheckpoint
from toile.reconstruction.adam import SuccessiveFramesAdam
from toile.reconstruction.problem import Reconstruction

MakeProblem = Callable[[], Reconstruction]
MakeAdam = Callable[..., SuccessiveFramesAdam]


class StoppedError(Exception):
    """Stands for anything that ends a fit early."""


class StopAt(Callback):
    """Ends a fit before cycle n, or within it after the parameters have been spoilt."""

    def __init__(self, n: int, spoil: bool) -> None:
        self.n, self.spoil = n, spoil

    def on_train_batch_start(self, trainer: Any, pl_module: Any, batch: Any, batch_idx: int) -> None:
        if pl_module.cycles_done == self.n:
            if self.spoil:
                with torch.no_grad():
                    pl_module.cloth_parameters.wind.add_(1.0)
            raise StoppedError


def fit(module: FitModule, *callbacks: Callback, checkpoint: Path | None = None) -> FitModule:
    trainer = Trainer(
        accelerator="cpu",
        devices=1,
        max_epochs=1,
        enable_checkpointing=any(isinstance(c, LastCheckpoint) for c in callbacks),
        enable_progress_bar=False,
        enable_model_summary=False,
        logger=False,
        log_every_n_steps=1,
        callbacks=list(callbacks),
    )
    trainer.fit(module, datamodule=CyclesOfFit(module), ckpt_path=checkpoint, weights_only=True)
    return module


def without_times(history: list[dict[str, float]]) -> list[dict[str, float]]:
    return [{k: v for k, v in row.items() if k not in ("seconds", PROCESSOR_SECONDS)} for row in history]


def assert_identical(a: FitModule, b: FitModule) -> None:
    for name, value in a.state_dict().items():
        assert torch.equal(value, b.state_dict()[name]), name
    assert without_times(a.history) == without_times(b.history)


def test_history_has_a_row_per_cycle(problem: MakeProblem, adam: MakeAdam) -> None:
    module = fit(FitModule(problem(), adam(), seed=0))
    assert module.cycles_done == module.n_cycles == 12
    assert [row["cycle"] for row in module.history] == list(range(12))
    assert [row["frames"] for row in module.history] == [3] * 3 + [4] * 3 + [5] * 6
    last = module.history[-1]
    terms = [last[f"loss {name}"] for name in ("image", "silhouette", "force_regularization")]
    assert last["loss"] == pytest.approx(sum(terms))
    # These terms are means over the frames already.
    assert last["loss per frame"] == last["loss"]
    assert last["stretching [network units]"] == module.cloth_parameters.stretching.item()
    assert last["turbulence rms [m/s²]"] > 0


def test_a_repeated_fit_is_bit_identical(problem: MakeProblem, adam: MakeAdam) -> None:
    assert_identical(fit(FitModule(problem(), adam(), 0)), fit(FitModule(problem(), adam(), 0)))


@pytest.mark.parametrize(("stop", "spoil"), [(1, False), (4, False), (4, True), (11, False)])
def test_a_resumed_fit_is_bit_identical(
    stop: int, spoil: bool, problem: MakeProblem, adam: MakeAdam, tmp_path: Path
) -> None:
    whole = fit(FitModule(problem(), adam(), 0))
    saving = LastCheckpoint(tmp_path, every=3, save_on_exception=True)
    with pytest.raises(StoppedError):
        fit(FitModule(problem(), adam(), 0), saving, StopAt(stop, spoil))
    resumed = fit(FitModule(problem(), adam(), 0), checkpoint=saving.path)
    assert resumed.cycles_done == 12
    assert_identical(resumed, whole)


def test_resuming_from_a_regular_checkpoint(problem: MakeProblem, adam: MakeAdam, tmp_path: Path) -> None:
    # As after a crash that left no time for a last one.
    whole = fit(FitModule(problem(), adam(), 0))
    saving = LastCheckpoint(tmp_path, every=3, save_on_exception=True)
    saving.on_exception = lambda *_: None  # type: ignore[method-assign]
    with pytest.raises(StoppedError):
        fit(FitModule(problem(), adam(), 0), saving, StopAt(8, spoil=False))
    assert torch.load(saving.path, weights_only=True)["toile_fit"]["cycles_done"] == 6
    assert_identical(fit(FitModule(problem(), adam(), 0), checkpoint=saving.path), whole)


def test_time_of_both_halves_of_a_fit_counts(problem: MakeProblem, adam: MakeAdam, tmp_path: Path) -> None:
    saving = LastCheckpoint(tmp_path, every=5, save_on_exception=True)
    halved = FitModule(problem(), adam(), 0)
    with pytest.raises(StoppedError):
        fit(halved, saving, StopAt(8, spoil=False))
    resumed = fit(FitModule(problem(), adam(), 0), checkpoint=saving.path)
    for column in ("seconds", PROCESSOR_SECONDS):
        times = [row[column] for row in resumed.history]
        assert min(times) > 0, column
        assert times[:8] == [row[column] for row in halved.history[:8]], column


def test_resuming_a_finished_fit_changes_nothing(
    problem: MakeProblem, adam: MakeAdam, tmp_path: Path
) -> None:
    saving = LastCheckpoint(tmp_path, every=5, save_on_exception=False)
    whole = fit(FitModule(problem(), adam(), 0), saving)
    assert_identical(fit(FitModule(problem(), adam(), 0), checkpoint=saving.path), whole)


def test_checkpoints_are_plain_data_and_complete(
    problem: MakeProblem, adam: MakeAdam, tmp_path: Path
) -> None:
    saving = LastCheckpoint(tmp_path, every=5, save_on_exception=False)
    module = fit(FitModule(problem(), adam(), 7), saving)
    assert [path.name for path in tmp_path.iterdir()] == ["last.ckpt"]
    checkpoint = torch.load(saving.path, weights_only=True)
    assert checkpoint["toile_fit"]["seed"] == 7
    assert checkpoint["toile_fit"]["history"] == module.history


def test_roll_back_undoes_half_a_cycle(problem: MakeProblem, adam: MakeAdam) -> None:
    module, reference = FitModule(problem(), adam(), 0), FitModule(problem(), adam(cycles=4), 0)
    with pytest.raises(StoppedError):
        fit(module, StopAt(4, spoil=True))
    module.roll_back()
    assert_identical(module, fit(reference))


def test_progress_as_log_lines(
    problem: MakeProblem,
    adam: MakeAdam,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # Not the lines that a slow machine would get beside them.
    monkeypatch.setattr("toile.progress.SECONDS_BETWEEN_LINES", math.inf)
    with caplog.at_level("INFO", logger="toile"):
        fit(FitModule(problem(), adam(cycles=3), 0), FitProgress(log_every=2))
    lines = [r.message.split(":")[0] for r in caplog.records]
    assert lines[0] == "fitting 5 frames in 3 cycles"
    assert lines[1:] == ["cycle 2 of 3", "cycle 3 of 3"]
    assert "3 of 5 frames" in caplog.records[1].message
