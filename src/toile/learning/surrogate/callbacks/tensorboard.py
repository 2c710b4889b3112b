"""TensorBoard: curves of the steps and epochs, pictures of the pool and of the validation rollout."""

from __future__ import annotations

from typing import Any, final

import torch
from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.loggers import TensorBoardLogger

from toile.learning.surrogate.module import SurrogateTraining
from toile.learning.surrogate.pictures import pixels, pool_picture, residual_curve
from toile.learning.surrogate.states import ClothStates
from toile.limits import Count

LAYOUT: dict[str, dict[str, list[Any]]] = {
    "training": {
        "residual, median of the batch": ["Multiline", [r"step/pass_\d+/residual_0\.5$"]],
        "change of the potential": ["Multiline", [r"step/pass_\d+/potential_change$"]],
        "accepted": ["Multiline", [r"step/pass_\d+/accepted$"]],
        "gradient norm": ["Multiline", ["step/gradient_norm$"]],
        "learning rate": ["Multiline", ["step/learning_rate$"]],
    },
    "validation": {"residual of the rollout": ["Multiline", ["epoch/validation_residual/"]]},
    "pool": {
        "resets": ["Multiline", ["epoch/resets/"]],
        "energies": ["Multiline", ["epoch/energy/"]],
        "age": ["Multiline", ["epoch/pool_age/"]],
    },
}
"""Charts of TensorBoard's Custom Scalars page: patterns that the tags of their curves begin with."""


@final
class CurveLogger(Callback):
    """Sends the measures of every few steps, and every row of the history, to whatever loggers there are.

    Args:
        every: steps between two points of a curve.
    """

    def __init__(self, every: Count) -> None:
        self.every = every

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Tell TensorBoard which curves share a chart."""
        for logger in trainer.loggers:
            if isinstance(logger, TensorBoardLogger):
                logger.experiment.add_custom_scalars(LAYOUT)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Log under ``step/`` and ``epoch/``."""
        assert isinstance(pl_module, SurrogateTraining)
        numbers: dict[str, float] = {}
        if pl_module.steps_done % self.every == 0:
            numbers |= {f"step/{_tag(name)}": value for name, value in pl_module.measures.items()}
        if pl_module.at_epoch_end:
            row = pl_module.history[-1]
            numbers |= {f"epoch/{_tag(name)}": row[name] for name in row if name not in ("epoch", "steps")}
        for logger in trainer.loggers if numbers else ():
            logger.log_metrics(numbers, step=pl_module.steps_done)


@final
class PictureLogger(Callback):
    """Draws a few cloths of the pool and the validation rollout into TensorBoard after every epoch.

    Args:
        cloths: number of cloths to draw.
    """

    def __init__(self, cloths: Count) -> None:
        self.cloths = cloths

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Draw if it is time."""
        assert isinstance(pl_module, SurrogateTraining)
        writers = [logger.experiment for logger in trainer.loggers if isinstance(logger, TensorBoardLogger)]
        if not (writers and pl_module.at_epoch_end and trainer.is_global_zero):
            return
        pool = pl_module.running_pool
        shown = torch.arange(min(self.cloths, pool.settings.size), device=pool.generator.device)
        states = pool.states.take(shown)
        pictures = {"pool": pixels(pool_picture(states.history[:, 0], _titles(states)))}
        if pl_module.validation is not None:
            pictures["validation rollout"] = pixels(residual_curve(pl_module.validation))
        for writer in writers:
            for name, picture in pictures.items():
                writer.add_image(name, picture, pl_module.steps_done, dataformats="HWC")


def _titles(states: ClothStates) -> list[str]:
    rows = zip(states.stiffness.tolist(), states.age.tolist(), states.pinned.sum(1).tolist(), strict=True)
    return [
        f"Y {y:.3g}, S {s:.3g}, B {b:.3g}, age {age}, {pinned} corners pinned"
        for (y, s, b), age, pinned in rows
    ]


def _tag(name: str) -> str:
    return name.replace(" ", "_")
