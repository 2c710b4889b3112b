"""Checkpoints from which an interrupted fit continues."""

from __future__ import annotations

from pathlib import Path
from typing import Any, final

from lightning import Callback, LightningModule, Trainer

from toile.atomic_file import written_atomically
from toile.learning.checkpoints import LAST
from toile.limits import Count


@final
class CycleCheckpoint(Callback):
    """Writes ``last.ckpt`` every few cycles, after the last one, and when a fit is interrupted or fails.

    The file is written under another name and then renamed, so there is always a complete one.

    Args:
        folder: where to write.
        every: cycles between two checkpoints.
    """

    NAME = LAST

    def __init__(self, folder: str | Path, every: Count) -> None:
        if every < 1:
            raise ValueError(f"every: expected at least 1 cycle, got {every}")
        self.path = Path(folder) / self.NAME
        self.every = every

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Save if it is time."""
        done = int(pl_module.cycles_done)  # type: ignore[arg-type]
        if done % self.every == 0 or done == pl_module.n_cycles:
            self._save(trainer)

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        """Save the last complete cycle."""
        if int(pl_module.cycles_done) > 0:  # type: ignore[arg-type]
            self._save(trainer)

    def _save(self, trainer: Trainer) -> None:
        with written_atomically(self.path) as temporary:
            trainer.save_checkpoint(temporary)
