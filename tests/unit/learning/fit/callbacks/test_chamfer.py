"""Chamfer distance while a fit runs: it looks on, and nothing else."""

from __future__ import annotations

import csv
import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning import Trainer

from toile.evaluation.evaluate import evaluate
from toile.learning.fit.callbacks.chamfer import CHAMFER, COMPARED, COVERED, CYCLE, ChamferLogger
from toile.learning.fit.callbacks.tensorboard import spread_frames
from toile.learning.fit.module import CyclesOfFit, FitModule
from toile.learning.last_checkpoint import LastCheckpoint
from toile.reconstruction.adam import SuccessiveFramesAdam
from toile.reconstruction.problem import Reconstruction

MakeProblem = Callable[[], Reconstruction]
MakeAdam = Callable[..., SuccessiveFramesAdam]


def fit(module: FitModule, *callbacks: Any, checkpoint: Path | None = None) -> FitModule:
    trainer = Trainer(
        accelerator="cpu",
        devices=1,
        max_epochs=1,
        enable_checkpointing=any(isinstance(c, LastCheckpoint) for c in callbacks),
        enable_progress_bar=False,
        enable_model_summary=False,
        logger=False,
        callbacks=list(callbacks),
    )
    trainer.fit(module, datamodule=CyclesOfFit(module), ckpt_path=checkpoint, weights_only=True)
    return module


def table(file: Path) -> list[dict[str, float]]:
    with file.open(newline="") as lines:
        return [{k: float(v) for k, v in row.items()} for row in csv.DictReader(lines)]


def test_a_fit_is_the_same_bit_for_bit_with_and_without_it(
    problem: MakeProblem, adam: MakeAdam, tmp_path: Path
) -> None:
    plain = fit(FitModule(problem(), adam(cycles=6), 0))
    state = torch.get_rng_state()
    watched = fit(FitModule(problem(), adam(cycles=6), 0), ChamferLogger(tmp_path / "c.csv", 1, None, seed=3))
    assert len(table(tmp_path / "c.csv")) == 6
    for name, value in plain.state_dict().items():
        assert torch.equal(value, watched.state_dict()[name]), name
    assert [r["loss"] for r in plain.history] == [r["loss"] for r in watched.history]
    assert torch.equal(torch.get_rng_state(), state)


def test_over_all_frames_it_is_the_chamfer_distance_of_the_evaluation(
    problem: MakeProblem, adam: MakeAdam, tmp_path: Path
) -> None:
    module = fit(FitModule(problem(), adam(cycles=7), 0), ChamferLogger(tmp_path / "c.csv", 3, None, seed=3))
    rows = table(tmp_path / "c.csv")
    assert [row[CYCLE] for row in rows] == [2, 5, 6]
    assert [row[COVERED] for row in rows] == [row[COMPARED] for row in rows] == [3, 4, 5]
    scene = module.reconstruction.scene
    assert module.report is not None
    motion = module.report.positions.reshape(scene.n_frames, *scene.grid, 3)
    # The same numbers, added up in another order.
    assert rows[-1][CHAMFER] == pytest.approx(evaluate(motion, scene, seed=3).mean("chamfer"), rel=1e-12)


def test_frames_the_fit_has_not_reached_are_left_out(
    problem: MakeProblem, adam: MakeAdam, tmp_path: Path
) -> None:
    assert spread_frames(5, 2) == [2, 4]
    fit(FitModule(problem(), adam(cycles=7), 0), ChamferLogger(tmp_path / "c.csv", 1, 2, seed=0))
    assert [row[COMPARED] for row in table(tmp_path / "c.csv")] == [1] * 6 + [2]


@pytest.mark.parametrize(("total", "n", "frames"), [(5, 9, [1, 2, 3, 4]), (50, 1, [49]), (2, 3, [1])])
def test_frames_are_spread_to_the_last_one(total: int, n: int, frames: list[int]) -> None:
    assert spread_frames(total, n) == frames


def test_a_resumed_fit_continues_the_table(problem: MakeProblem, adam: MakeAdam, tmp_path: Path) -> None:
    def logger(name: str) -> ChamferLogger:
        return ChamferLogger(tmp_path / name, 2, None, seed=0)

    fit(FitModule(problem(), adam(), 0), logger("whole.csv"))
    saving = LastCheckpoint(tmp_path, every=5, save_on_exception=False)
    interrupted = FitModule(problem(), adam(), 0)
    interrupted.n_cycles = 7
    saving.on_train_epoch_end = lambda *_: None  # type: ignore[method-assign]
    fit(interrupted, saving, logger("part.csv"))
    # Cycle 5 was evaluated but is not in the checkpoint, and cycle 6 was the last one of that run.
    assert [row[CYCLE] for row in table(tmp_path / "part.csv")] == [1, 3, 5, 6]
    fit(FitModule(problem(), adam(), 0), logger("part.csv"), checkpoint=saving.path)
    assert table(tmp_path / "part.csv") == table(tmp_path / "whole.csv")


def test_a_new_fit_forgets_the_table_of_another(problem: MakeProblem, adam: MakeAdam, tmp_path: Path) -> None:
    for _ in range(2):
        fit(FitModule(problem(), adam(cycles=2), 0), ChamferLogger(tmp_path / "c.csv", 1, None, seed=0))
    assert [row[CYCLE] for row in table(tmp_path / "c.csv")] == [0, 1]


def test_without_ground_truth_there_is_no_table(problem: MakeProblem, adam: MakeAdam, tmp_path: Path) -> None:
    unknown = problem()
    unknown.scene = dataclasses.replace(unknown.scene, ground_truth=None)
    callback = ChamferLogger(tmp_path / "c.csv", 1, None, seed=0)
    fit(FitModule(unknown, adam(cycles=2), 0), callback)
    assert not callback.has_targets
    assert not (tmp_path / "c.csv").exists()


def test_frames_without_ground_truth_are_left_out(
    problem: MakeProblem, adam: MakeAdam, tmp_path: Path
) -> None:
    partly = problem()
    truth = partly.scene.ground_truth
    assert truth is not None
    assert truth.vertices is not None
    short = dataclasses.replace(truth, vertices=truth.vertices[:2], point_clouds=None)
    partly.scene = dataclasses.replace(partly.scene, ground_truth=short)
    fit(FitModule(partly, adam(cycles=2), 0), ChamferLogger(tmp_path / "c.csv", 2, None, seed=0))
    assert [row[COMPARED] for row in table(tmp_path / "c.csv")] == [2]


def test_a_motion_that_is_not_finite_does_not_end_the_fit(
    problem: MakeProblem, adam: MakeAdam, tmp_path: Path
) -> None:
    module, callback = FitModule(problem(), adam(cycles=1), 0), ChamferLogger(tmp_path / "c.csv", 1, None, 0)
    fit(module, callback)
    assert module.report is not None
    module.report.positions[1, 0, 0] = torch.nan
    callback.on_train_batch_end(Trainer(logger=False, enable_checkpointing=False), module, None, None, 0)
    assert [math.isnan(row[CHAMFER]) for row in table(tmp_path / "c.csv")] == [False, True]
