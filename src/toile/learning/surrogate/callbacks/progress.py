"""Progress of a training run on the terminal."""

from __future__ import annotations

import logging
from typing import Any, final

from lightning import Callback, LightningModule, Trainer

from toile.learning.surrogate.module import SurrogateTraining
from toile.progress import Shown

log = logging.getLogger(__name__)


@final
class EpochLines(Callback):
    """One line per epoch; in between a bar on a terminal, and a line every ten seconds elsewhere."""

    def __init__(self) -> None:
        self._shown: Shown | None = None

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Begin to count."""
        assert isinstance(pl_module, SurrogateTraining)
        if trainer.is_global_zero:
            self._shown = Shown(log).__enter__()
            self._shown("step", pl_module.steps_done, pl_module.settings.n_steps)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Take the bar away."""
        self._stop()

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        """Take the bar away."""
        self._stop()

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Write the line after the last step of an epoch."""
        assert isinstance(pl_module, SurrogateTraining)
        if self._shown is not None:
            self._shown("step", pl_module.steps_done, pl_module.settings.n_steps)
        if not (pl_module.at_epoch_end and trainer.is_global_zero):
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
        if self._shown is not None:
            self._shown.said()

    def _stop(self) -> None:
        if self._shown is not None:
            self._shown.__exit__()
            self._shown = None
