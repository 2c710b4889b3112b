"""Progress of a training run on the terminal."""

from __future__ import annotations

import logging
from typing import Any, final

from lightning import LightningModule, Trainer

from toile.learning.progress import ProgressShown
from toile.learning.surrogate.module import SurrogateTraining

log = logging.getLogger(__name__)


@final
class EpochLines(ProgressShown):
    """One line per epoch; in between a bar on a terminal, and a line every ten seconds elsewhere."""

    def __init__(self) -> None:
        super().__init__(log, leave=False)

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Begin to count."""
        super().on_train_start(trainer, pl_module)
        self._count(pl_module)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Move the bar."""
        self._count(pl_module)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Write the line of the epoch."""
        assert isinstance(pl_module, SurrogateTraining)
        if self.shown is None:
            return
        row, passes = pl_module.history[-1], pl_module.settings.n_passes
        log.info(
            "epoch %d of %d: residual %.3g (0.9: %.3g), accepted %.0f %%, validation %.3g (0.9: %.3g), "
            "age %.0f, rate %.2g, %.1f min",
            pl_module.epochs_done,
            pl_module.settings.epochs,
            row[f"pass {passes}/residual 0.5"],
            row[f"pass {passes}/residual 0.9"],
            100 * row[f"pass {passes}/accepted"],
            row["validation residual/median"],
            row["validation residual/0.9"],
            row["pool age/mean"],
            pl_module.measures["learning rate"],
            pl_module.seconds / 60,
        )
        self.shown.said()

    def _count(self, pl_module: LightningModule) -> None:
        assert isinstance(pl_module, SurrogateTraining)
        if self.shown is not None:
            self.shown("step", pl_module.steps_done, pl_module.settings.n_steps)
