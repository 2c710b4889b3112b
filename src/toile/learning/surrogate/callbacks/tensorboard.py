"""TensorBoard: charts of the steps and epochs, pictures of the pool and of the validation rollout."""

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
class DashboardLayout(Callback):
    """Tells TensorBoard which curves share a chart."""

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Write the layout."""
        for logger in trainer.loggers:
            if isinstance(logger, TensorBoardLogger):
                logger.experiment.add_custom_scalars(LAYOUT)


@final
class PictureLogger(Callback):
    """Draws a few cloths of the pool and the validation rollout into TensorBoard after every epoch.

    Args:
        cloths: number of cloths to draw.
    """

    def __init__(self, cloths: Count) -> None:
        self.cloths = cloths

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Draw."""
        assert isinstance(pl_module, SurrogateTraining)
        writers = [logger.experiment for logger in trainer.loggers if isinstance(logger, TensorBoardLogger)]
        if not (writers and trainer.is_global_zero):
            return
        pool = pl_module.pool
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
