"""``toile capture pose | warm | physics | adapt``: training of the networks, stage by stage."""

from __future__ import annotations

import csv
import io
import json
import logging
import resource
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from lightning.pytorch.loggers import TensorBoardLogger
from omegaconf import DictConfig

from toile.atomic_file import write_text
from toile.capture.training.frames import TrainingSet
from toile.capture.training.weights import Networks, NetworkSettings, load_networks, weights_digest
from toile.cli.alone import alone_in
from toile.cli.checkpoints import check_checkpoint
from toile.cli.configuration import instantiate
from toile.cli.terminal import print_path
from toile.cli.trainer import make_trainer
from toile.errors import InputError
from toile.json_file import read_json_object
from toile.learning.capture.adaptation import AdaptationStage
from toile.learning.capture.callbacks import StagePictures, StageProgress
from toile.learning.capture.physics_stage import PhysicsStage
from toile.learning.capture.pose_stage import PoseStage
from toile.learning.capture.stage import STATE, Stage
from toile.learning.capture.warm_stage import WarmStage
from toile.learning.checkpoints import LAST
from toile.learning.last_checkpoint import LastCheckpoint
from toile.learning.quiet import quiet_lightning
from toile.progress import Shown
from toile.workers import processes

log = logging.getLogger(__name__)

WEIGHTS, DESCRIPTION, LOSSES = "weights.pt", "stage.json", "losses.csv"
RESOURCES = "resources.json"
"""Time of the processor and memory that the stage took in the process that finished it."""

_STAGES: Mapping[str, Callable[[Any, Networks, TrainingSet, int], Stage]] = {
    "pose": PoseStage,
    "warm": WarmStage,
    "physics": PhysicsStage,
    "adapt": AdaptationStage,
}
_ORDER = ("pose", "warm", "physics")


def train(cfg: DictConfig, last: str) -> Path:
    """Train the stages up to one, those that are done already left out.

    A stage lies in a folder of its own: weights.pt, losses.csv, stage.json (what it follows from),
    resources.json (time and memory), its last checkpoint and TensorBoard. The same command continues a stage
    that was interrupted, bit for bit.

    Args:
        cfg: configuration of the command.
        last: pose, warm or physics.

    Returns:
        Weights of the last stage.

    Raises:
        InputError: a folder holds a stage of other settings, or data or weights are unusable.
    """
    quiet_lightning()
    settings: NetworkSettings = instantiate(cfg.networks)
    with Shown(log) as progress:
        data = TrainingSet.load(Path(str(cfg.folder)), settings.backbone.side)
        data.prepare(progress)
    before, done = _start(cfg)
    if _ORDER.index(last) < done:
        raise InputError(
            "Stage comes before that of the weights",
            where="weights",
            expected=f"weights of a stage before {last}",
            got=f"{before}: {_ORDER[done - 1]}",
        )
    for name in _ORDER[done : _ORDER.index(last) + 1]:
        label = f"{name}-{cfg.variant}" if cfg.variant and name == "physics" else name
        before = _stage(cfg, name, Path(str(cfg.output)) / label, data, settings, before)
    assert before is not None
    return before


def _start(cfg: DictConfig) -> tuple[Path | None, int]:
    """Weights to begin with, and how many stages they have behind them.

    Raises:
        InputError: weights of no stage that others follow.
    """
    if cfg.weights is None:
        return None, 0
    path = Path(str(cfg.weights))
    stage = load_networks(path).description.get("stage", "none")
    if stage not in _ORDER:
        raise InputError(
            "Weights cannot be trained on",
            where=str(path),
            expected=f"weights of {' or '.join(_ORDER[:-1])}",
            got=f"those of {stage}",
        )
    return path, _ORDER.index(stage) + 1


def adapt(cfg: DictConfig) -> Path:
    """Refine trained networks on a clip, by what one of its cameras has seen.

    Args:
        cfg: configuration of the command; ``run`` is the clip or a set of them, ``view`` the camera.

    Raises:
        InputError: see ``train``.
    """
    quiet_lightning()
    weights = Path(str(cfg.output)) / "physics" / WEIGHTS if cfg.weights is None else Path(str(cfg.weights))
    settings = load_networks(weights).settings
    clip = Path(str(cfg.run))
    with Shown(log) as progress:
        data = TrainingSet.load(clip, settings.backbone.side).only(int(cfg.view))
        data.prepare(progress)
    folder = Path(str(cfg.output)) / "adapt" / f"{clip.name}-camera{int(cfg.view)}"
    return _stage(cfg, "adapt", folder, data, settings, weights)


def _stage(
    cfg: DictConfig,
    name: str,
    folder: Path,
    data: TrainingSet,
    settings: NetworkSettings,
    before: Path | None,
) -> Path:
    """Train one stage from the weights of the one before, or what is missing of it."""
    weights = folder / WEIGHTS
    with alone_in(folder):
        stage_settings = instantiate(cfg.stages[name])
        networks = _networks(name, data, settings, int(cfg.seed), before)
        stage = _STAGES[name](stage_settings, networks, data, int(cfg.seed))
        if isinstance(stage, PhysicsStage):
            stage.share(processes(int(cfg.workers)))
        description = _description(cfg, stage, before)
        _claim(folder, description)
        if weights.is_file():
            log.info("%s: done before", weights)
            return weights
        checkpoint: Path | None = folder / "checkpoints" / LAST
        assert checkpoint is not None
        if checkpoint.is_file():
            check_checkpoint(checkpoint, stage, STATE, "training")
            log.info("continuing from %s", checkpoint)
        else:
            checkpoint = None
        callbacks = [
            LastCheckpoint(folder / "checkpoints", int(cfg.checkpoint_every), save_on_exception=False),
            StageProgress(),
            StagePictures(int(cfg.pictures_every)),
        ]
        logger = TensorBoardLogger(save_dir=folder, name="tensorboard", version="")
        trainer = make_trainer(cfg.trainer, callbacks, logger)
        begin = time.process_time()
        trainer.fit(stage, ckpt_path=checkpoint, weights_only=True)
        if not stage.finished:
            raise KeyboardInterrupt
        write_text(folder / LOSSES, _table(stage.losses))
        taken = {
            "processor_s": round(time.process_time() - begin, 1),
            # In kilobytes; of everything that the process has done so far.
            "peak_memory_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024),
        }
        write_text(folder / RESOURCES, json.dumps(taken, indent=1) + "\n")
        networks.save(
            weights,
            {
                "stage": name,
                "seed": str(int(cfg.seed)),
                "data": data.source,
                "steps": str(stage_settings.steps),
                "loss, mean of the last tenth": f"{_last_loss(stage):.4g}",
            },
        )
    print_path(weights)
    return weights


def _networks(
    name: str, data: TrainingSet, settings: NetworkSettings, seed: int, before: Path | None
) -> Networks:
    """The networks that a stage begins with."""
    if before is None:
        return Networks.new(data.subject, data.garment, settings, seed)
    networks = load_networks(before)
    if name == "warm":
        return networks.resized(settings, str(before)).with_sim_net()
    if networks.settings != settings:
        raise InputError(
            "Networks have another size",
            where=str(before),
            expected=str(settings),
            got=str(networks.settings),
        )
    return networks


def _description(cfg: DictConfig, stage: Stage, before: Path | None) -> dict[str, Any]:
    """Everything that a stage's weights follow from, as JSON values."""
    values = {
        "stage": stage.NAME,
        "settings": asdict(stage.settings),
        "networks": asdict(stage.networks.settings),
        "seed": stage.seed,
        "data": stage.data.source,
        "cameras": list(stage.data.seeing),
        "from": None if before is None else weights_digest(before),
    }
    plain: dict[str, Any] = json.loads(json.dumps(values))
    return plain


def _claim(folder: Path, description: dict[str, Any]) -> None:
    """Write what a stage follows from into its folder, or check that it is the same."""
    path = folder / DESCRIPTION
    if not path.is_file():
        write_text(path, json.dumps(description, indent=1) + "\n")
        return
    try:
        there = read_json_object(path)
    except ValueError as error:
        there = {DESCRIPTION: str(error)}
    if there != description:
        old, new = _flat(there), _flat(description)
        differing = sorted(key for key in old.keys() | new.keys() if old.get(key) != new.get(key))
        raise InputError(
            "The folder holds a stage with other settings",
            where=str(folder),
            expected="the settings it was started with, or another folder (output=...)",
            got="; ".join(f"{key}: {new.get(key)} instead of {old.get(key)}" for key in differing[:6]),
        )


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, dict):
            flat |= _flat(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat


def _table(rows: list[dict[str, float]]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(
        text, list(dict.fromkeys(key for row in rows for key in row)), lineterminator="\n"
    )
    writer.writeheader()
    writer.writerows({key: f"{value:.6g}" for key, value in row.items()} for row in rows)
    return text.getvalue()


def _last_loss(stage: Stage) -> float:
    rows = stage.losses[-max(1, len(stage.losses) // 10) :]
    return sum(row["loss"] for row in rows) / len(rows)
