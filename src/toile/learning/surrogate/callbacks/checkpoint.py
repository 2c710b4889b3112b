"""Checkpoints from which a training run continues."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Any, final

from lightning import Callback, LightningModule, Trainer

from toile.atomic_file import written_atomically
from toile.learning.surrogate.module import SurrogateTraining
from toile.limits import Count


@final
class StepCheckpoint(Callback):
    """Writes ``last.ckpt`` between two steps: every few, after the last one, and when the run is to stop.

    The file is written under another name and then renamed, so there is always a complete one. Whatever may
    ask for a stop must come before this among the callbacks.

    Args:
        folder: where to write.
        every: steps between two checkpoints; a crash loses as many at most.
    """

    NAME = "last.ckpt"

    def __init__(self, folder: str | Path, every: Count) -> None:
        if every < 1:
            raise ValueError(f"every: expected at least 1 step, got {every}")
        self.path = Path(folder) / self.NAME
        self.every = every

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Save if it is time."""
        assert isinstance(pl_module, SurrogateTraining)
        if pl_module.steps_done % self.every == 0 or pl_module.finished or trainer.should_stop:
            self._save(trainer)

    def _save(self, trainer: Trainer) -> None:
        # All processes take part; the first one writes.
        first = trainer.is_global_zero
        with written_atomically(self.path) if first else nullcontext(self.path) as path:
            trainer.save_checkpoint(path)
