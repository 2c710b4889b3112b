"""What fits and trainings show of their progress: opened when a run starts, closed when it ends or fails."""

from __future__ import annotations

import logging

from lightning import Callback, LightningModule, Trainer

from toile.progress import Shown


class ProgressShown(Callback):
    """A bar on a terminal, lines in the log elsewhere; the first process shows it.

    Args:
        log: of the lines.
        leave: whether the bar stays when the run has ended.

    Attributes:
        shown: while the run goes on, None before and after.
    """

    def __init__(self, log: logging.Logger, leave: bool) -> None:
        self.shown: Shown | None = None
        self._log = log
        self._leave = leave

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Open it."""
        if trainer.is_global_zero:
            self.shown = Shown(self._log, leave=self._leave).__enter__()

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Close it."""
        if self.shown is not None:
            self.shown.__exit__()
            self.shown = None

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        """Close it."""
        self.on_train_end(trainer, pl_module)
