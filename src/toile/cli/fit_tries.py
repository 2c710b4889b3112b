"""One fit, or two where the first one loses the cloth."""

from __future__ import annotations

import logging
import math
import signal
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lightning.pytorch.trainer.states import TrainerStatus
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from toile.cli.checkpoints import check_checkpoint
from toile.cli.configuration import instantiate
from toile.cli.resume import checkpoint_path
from toile.cli.trainer import make_trainer
from toile.learning.fit.module import PROCESSOR_SECONDS, STATE, CyclesOfFit, FitModule
from toile.reconstruction.fitted_motion import final_trajectory
from toile.reconstruction.lost_cloth import LostClothGuard
from toile.reconstruction.problem import Reconstruction
from toile.reconstruction.recipe import Recipe
from toile.reports.run_folder import RunFolder
from toile.scenes.scene import Scene

log = logging.getLogger(__name__)

SECOND_TRY = "second_try"
"""Folder in the run folder with checkpoints and logs of the second try."""


WRITING = ("callbacks", "logger")
"""Parts of the configuration that name places to write to."""

MakeReconstruction = Callable[[DictConfig, Scene], Reconstruction]


@dataclass(frozen=True)
class Fitted:
    """What the tries have come to.

    Attributes:
        module: of the try that counts, after it.
        trajectory: of that try (F, H, W, 3) [m]; None where it was stopped before its first cycle was done.
        interrupted: in which try: "", "fit" or "second try".
        warnings: where the cloth is lost, for the console, the log and the page.
        seconds: of all cycles of all tries.
        processor_seconds: of the same cycles, see PROCESSOR_SECONDS.
    """

    module: FitModule
    trajectory: Tensor | None
    interrupted: str
    warnings: tuple[str, ...]
    seconds: float
    processor_seconds: float


def fit_with_guard(
    cfg: DictConfig, scene: Scene, folder: RunFolder, checkpoint: Path | None, make: MakeReconstruction
) -> Fitted:
    """Fit; where the outline says that the cloth is lost, once more with a heavier silhouette.

    The try that keeps the cloth longer counts, the first where both keep it as long.

    Args:
        cfg: configuration of the command.
        scene: see Scene.
        folder: of the run.
        checkpoint: of the first try, to continue from.
        make: makes the problem anew for every try.
    """
    recipe: Recipe = instantiate(cfg.optimization)
    module = FitModule(make(cfg, scene), recipe, cfg.seed)
    interrupted = optimise(cfg, module, checkpoint)
    if interrupted:
        motion = None if module.cycles_done == 0 else _trajectory(module)
        return Fitted(module, motion, "fit", (), *_seconds(module))
    trajectory = _trajectory(module)
    guard: LostClothGuard = instantiate(cfg.lost_cloth)
    kept = guard.first_lost(module.reconstruction, trajectory)
    first = Fitted(module, trajectory, "", _lost(kept, scene), *_seconds(module))
    if kept == scene.n_frames or guard.mask_factor is None:
        return _said(first)
    heavier = instantiate(cfg.optimization).with_heavier_silhouette(guard.mask_factor)
    if heavier is None:
        return _said(first)
    log.warning(
        "the cloth is lost from frame %d on; second try, silhouette %g times heavier", kept, guard.mask_factor
    )
    place = RunFolder(folder.path / SECOND_TRY)
    second = FitModule(make(cfg, scene), heavier, cfg.seed)
    last = checkpoint_path(place)
    interrupted = optimise(_moved(cfg, folder.path, place.path), second, last if last.is_file() else None)
    used = [a + b for a, b in zip((first.seconds, first.processor_seconds), _seconds(second), strict=True)]
    first = replace(first, seconds=used[0], processor_seconds=used[1])
    if interrupted:
        return replace(_said(first), interrupted="second try")
    motion = _trajectory(second)
    kept_now = guard.first_lost(second.reconstruction, motion)
    if kept_now <= kept:
        return _said(first)
    note = f"[warning] The first try lost the cloth in frame {kept}; this is a second one with a silhouette "
    note += f"{guard.mask_factor:g} times heavier in its first stage"
    return _said(Fitted(second, motion, "", (note, *_lost(kept_now, scene)), *used))


def optimise(cfg: DictConfig, module: FitModule, checkpoint: Path | None) -> bool:
    """Run the cycles, from a checkpoint if there is one; returns whether it was interrupted."""
    callbacks = [c for c in instantiate(cfg.callbacks).values() if c is not None]
    logger: Any = instantiate(cfg.logger) if cfg.get("logger") else False
    trainer = make_trainer(cfg.trainer, callbacks, logger)
    if checkpoint is not None:
        check_checkpoint(checkpoint, module, STATE, "fit")
        log.info("continuing from %s", checkpoint)
    on_interrupt = signal.getsignal(signal.SIGINT)
    try:
        trainer.fit(module, datamodule=CyclesOfFit(module), ckpt_path=checkpoint, weights_only=True)
    except SystemExit:
        # Lightning turns Ctrl-C into this, and ignores Ctrl-C from then on.
        if trainer.state.status is not TrainerStatus.INTERRUPTED:
            raise
        signal.signal(signal.SIGINT, on_interrupt)
        module.roll_back()
        return True
    return False


def _trajectory(module: FitModule) -> Tensor:
    return final_trajectory(module.reconstruction, module.recipe.substep_positions())


def _seconds(module: FitModule) -> tuple[float, float]:
    """On the clock, and of the processor; a checkpoint of an older version lacks the latter: then NaN."""
    columns = ("seconds", PROCESSOR_SECONDS)
    wall, processor = (float(sum(row.get(c, math.nan) for row in module.history)) for c in columns)
    return wall, processor


def _lost(kept: int, scene: Scene) -> tuple[str, ...]:
    if kept == scene.n_frames:
        return ()
    return (
        f"[warning] The cloth is lost from frame {kept} on: the outline of the fitted motion overlaps with "
        "the masks far less than in frame 0, so what follows is no motion of this cloth",
    )


def _said(fitted: Fitted) -> Fitted:
    for warning in fitted.warnings:
        log.warning("%s", warning)
    return fitted


def _moved(cfg: DictConfig, folder: Path, place: Path) -> DictConfig:
    """The configuration with callbacks and loggers writing to another place."""

    def moved(node: Any) -> Any:
        if isinstance(node, dict):
            return {key: moved(value) for key, value in node.items()}
        if isinstance(node, str) and Path(node).is_relative_to(folder):
            return str(place / Path(node).relative_to(folder))
        return node

    parts = {key: moved(OmegaConf.to_container(cfg[key], resolve=True)) for key in WRITING if cfg.get(key)}
    # What is written elsewhere is resolved; the rest keeps its references.
    kept = OmegaConf.masked_copy(cfg, [str(key) for key in cfg if key not in parts])
    merged = OmegaConf.merge(kept, parts)
    assert isinstance(merged, DictConfig)
    return merged
