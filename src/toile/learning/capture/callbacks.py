"""What a stage shows while it trains: progress and pictures in TensorBoard."""

from __future__ import annotations

import logging
from typing import Any

import torch
from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.loggers import TensorBoardLogger
from torch import Tensor

from toile.learning.capture.stage import Stage
from toile.learning.progress import ProgressShown
from toile.limits import Count

log = logging.getLogger(__name__)


class StageProgress(ProgressShown):
    """A bar with the loss on a terminal, lines elsewhere."""

    def __init__(self) -> None:
        super().__init__(log, leave=False)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """A step is done."""
        if self.shown is not None and isinstance(pl_module, Stage) and pl_module.losses:
            loss = pl_module.losses[-1]["loss"]
            self.shown(pl_module.NAME, len(pl_module.losses), pl_module.settings.steps, f"loss {loss:.4g}")


class StagePictures(Callback):
    """Input images of some steps in TensorBoard, and where in them garment and landmarks are said to be.

    Args:
        every: steps between two.
    """

    def __init__(self, every: Count = 100) -> None:
        self.every = every

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Draw the last step's frames if it is time."""
        logger = trainer.logger
        if not isinstance(pl_module, Stage) or not isinstance(logger, TensorBoardLogger):
            return
        if batch_idx % self.every == 0 and pl_module.last is not None:
            logger.experiment.add_image(f"{pl_module.NAME}/frames", drawn(pl_module), trainer.global_step)


def drawn(stage: Stage, most: int = 6) -> Tensor:
    """Frames of the last step side by side, (3, H, n W) in [0, 1]; garment in blue, landmarks in red."""
    assert stage.last is not None
    batch, world = stage.last
    shown = []
    for k, sample in enumerate(batch.samples[:most]):
        view = stage.data.clips[sample.clip].recording.views[sample.camera]
        picture = view.frame(sample.frame).clone()
        colours = ((world.garment[k], (0.2, 0.4, 1.0)), (world.landmarks[k], (1.0, 0.1, 0.1)))
        for points, colour in colours:
            column, row = view.camera.project(points.detach().cpu()).floor().long().unbind(-1)
            inside = (column >= 0) & (row >= 0) & (column < view.camera.width) & (row < view.camera.height)
            picture[row[inside], column[inside]] = torch.tensor(colour)
        shown.append(picture)
    return torch.cat(shown, 1).permute(2, 0, 1)
