"""``toile train training=cpu``: train the neural surrogate of a time step."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pandas as pd
import torch
from hydra.core.hydra_config import HydraConfig
from lightning import Callback, Trainer
from omegaconf import DictConfig

from toile.cli.alone import alone
from toile.cli.checkpoints import check_checkpoint
from toile.cli.configuration import instantiate, output_folder, resolved_yaml
from toile.cli.machine import machine
from toile.cli.resume import last_checkpoint
from toile.cli.terminal import print_path
from toile.cli.trainer import make_trainer
from toile.errors import InputError
from toile.learning.quiet import quiet_lightning
from toile.learning.surrogate.average import AverageSurrogate
from toile.learning.surrogate.batches import PoolBatches
from toile.learning.surrogate.callbacks.stopping import StopBetweenSteps
from toile.learning.surrogate.module import STATE, SurrogateTraining
from toile.learning.surrogate.pictures import residual_curve
from toile.learning.surrogate.settings import TrainingSettings
from toile.physics.surrogate.surrogate import Surrogate
from toile.physics.surrogate.weights import load_weights, packaged_weights, save_weights
from toile.reports.figures import save_figure
from toile.reports.run_folder import (
    RunFolder,
    create_run_folder,
    current_git_revision,
    write_config,
    write_git_revision,
    write_history,
    write_metrics,
    write_overrides,
)

log = logging.getLogger(__name__)

WEIGHTS = "surrogate.pt"
"""Averaged weights in the run folder."""
PACKAGED = "packaged"
"""Setting ``weights``: those of the package."""


@alone
def run(cfg: DictConfig) -> None:
    """Train, and fill the run folder; an interrupted run leaves what it has and can be continued."""
    quiet_lightning()
    folder = create_run_folder(output_folder())
    config = resolved_yaml(cfg)
    checkpoint = last_checkpoint(folder, config)
    settings: TrainingSettings = instantiate(cfg.training)
    torch.set_num_threads(cfg.threads or os.cpu_count() or 1)
    torch.manual_seed(cfg.seed)
    module = SurrogateTraining(_start(cfg.weights, settings), settings)
    stop, average = StopBetweenSteps(cfg.max_minutes), AverageSurrogate(settings.average_decay)
    trainer = build_trainer(cfg, stop, average)
    if trainer.is_global_zero:
        write_config(folder, config)
        if checkpoint is None or not folder.overrides.is_file():
            # What the run was started with; what a later call adds may yet turn out to be wrong.
            write_overrides(folder, HydraConfig.get().overrides.task)
        write_git_revision(folder)
    if checkpoint is not None:
        check_checkpoint(checkpoint, module, STATE, "training")
        log.info("continuing from %s", checkpoint)
    with _restartable_command():
        trainer.fit(
            module, datamodule=PoolBatches(settings, cfg.seed), ckpt_path=checkpoint, weights_only=True
        )
    if not trainer.is_global_zero:
        return
    write_results(folder, cfg, module, average.surrogate)
    if not module.finished:
        late = f"{stop.minutes:g} minutes are over" if stop.out_of_time else "by the trainer"
        reason = "interrupted" if stop.interrupted else late
        print_path(folder.path, f": stopped after {module.steps_done} of {settings.n_steps} steps, {reason}")
        more = " max_minutes=<more, or null>" if stop.out_of_time and not stop.interrupted else ""
        print_path(f"toile train resume={folder.path}{more}", " continues")
        if stop.interrupted:
            raise KeyboardInterrupt
    print_path(folder.path / WEIGHTS)


def _start(weights: str | None, settings: TrainingSettings) -> Surrogate:
    """The network before the first step.

    Raises:
        InputError: the weights cannot be read, or are of a network of other widths.
    """
    if weights is None:
        return Surrogate(settings.widths)
    surrogate = load_weights(packaged_weights() if weights == PACKAGED else Path(weights))
    if surrogate.network.widths != tuple(settings.widths):
        raise InputError(
            "the weights to start from are of another network",
            where="weights",
            expected=f"widths {list(settings.widths)} (training.widths)",
            got=str(list(surrogate.network.widths)),
        )
    return surrogate.train().requires_grad_(True)


def build_trainer(cfg: DictConfig, *own: Callback) -> Trainer:
    """The trainer with the command's own callbacks, which come first, and the configured ones."""
    callbacks = [*own, *(c for c in instantiate(cfg.callbacks).values() if c is not None)]
    logger: Any = instantiate(cfg.logger) if cfg.get("logger") else False
    return make_trainer(cfg.trainer, callbacks, logger)


def write_results(folder: RunFolder, cfg: DictConfig, module: SurrogateTraining, average: Surrogate) -> None:
    """Write the averaged weights, the history, and what the last validation has shown."""
    last = module.history[-1] if module.history else {}
    start = f" weights={cfg.weights}" if cfg.weights else ""
    description = {
        "command": f"toile train training={cfg.training_name}{start}",
        "machine": "{processor}, {processors} cores, {threads} threads".format(**machine()),
        "grid": "x".join(map(str, module.settings.pool.grid)),
        "steps": f"{module.steps_done} of {module.settings.n_steps}",
        "minutes": f"{module.seconds / 60:.1f}",
        "seed": str(cfg.seed),
        "git revision": current_git_revision(),
        "validation residual, median": f"{last.get('validation residual/median', float('nan')):.4g}",
    }
    save_weights(folder.path / WEIGHTS, average, description)
    if module.history:
        write_history(folder, pd.DataFrame(module.history))
    if module.validation is not None:
        save_figure(residual_curve(module.validation), folder.figures / "validation.png")
    numbers = {name: value for name, value in last.items() if abs(value) < float("inf")}
    write_metrics(
        folder,
        {
            "training": {
                "steps": module.steps_done,
                "steps of the whole run": module.settings.n_steps,
                "seconds": module.seconds,
                "last epoch": numbers,
            },
            "machine": machine(),
        },
    )


@contextmanager
def _restartable_command() -> Iterator[None]:
    """Lightning starts further processes by repeating the command; show it one that can be repeated."""
    before = sys.argv
    sys.argv = [str(Path(sys.executable).with_name("toile")), "train", *before[1:]]
    try:
        yield
    finally:
        sys.argv = before
