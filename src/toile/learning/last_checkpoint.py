"""The checkpoint from which an interrupted fit or training continues."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Any, final

from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint

from toile.atomic_file import written_atomically
from toile.learning.checkpoints import LAST
from toile.limits import Count


@final
class LastCheckpoint(ModelCheckpoint):
    """Keeps ``last.ckpt``: every few steps, at the end of every epoch, and when the run is to stop.

    The file is written under another name and then renamed, so there is always a complete one. At the end of
    an epoch it is written behind the validation, so that a resumed run does not miss that.

    Lightning counts the steps of its optimisers, and a recipe has none that Lightning sees; so batches are
    counted here. They are the steps of a training and the cycles of a fit.

    Args:
        folder: where to write.
        every: steps or cycles between two checkpoints; a crash loses as many at most.
        save_on_exception: also when the run fails or is interrupted within a step, if one is complete. Only
            for modules whose checkpoint holds the state after the last complete step.

    Raises:
        ValueError: ``every`` is less than 1.
    """

    CHECKPOINT_NAME_LAST = Path(LAST).stem

    def __init__(self, folder: str | Path, every: Count, save_on_exception: bool) -> None:
        if every < 1:
            raise ValueError(f"every: expected at least 1 step, got {every}")
        super().__init__(
            dirpath=folder,
            save_last=True,
            save_top_k=0,
            save_on_exception=save_on_exception,
            enable_version_counter=False,
        )
        self.path = Path(folder) / LAST
        self.every = every

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Save if it is time."""
        done = trainer.current_epoch * int(trainer.num_training_batches) + batch_idx + 1
        if (done % self.every == 0 or trainer.should_stop) and not _at_epoch_end(trainer):
            self._save_last_checkpoint(trainer, {})

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Save, unless the run has stopped within the epoch."""
        if _at_epoch_end(trainer):
            self._save_last_checkpoint(trainer, {})

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Not yet: the epoch is about to end."""

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """No more: by now the average may have taken the place of the weights."""

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        """Save the last complete step, where the module knows it."""
        progress: Any = trainer.fit_loop.epoch_loop.batch_progress.total
        if self.save_on_exception and progress.processed:
            self._save_last_checkpoint(trainer, {})

    def state_dict(self) -> dict[str, Any]:
        """Nothing: where the file lies is known, and the folder may have moved when the run continues."""
        return {}

    def _save_checkpoint(self, trainer: Trainer, filepath: str) -> None:
        # All processes take part; the first one writes.
        path = Path(filepath)
        with written_atomically(path) if trainer.is_global_zero else nullcontext(path) as temporary:
            super()._save_checkpoint(trainer, str(temporary))


def _at_epoch_end(trainer: Trainer) -> bool:
    return trainer.fit_loop.epoch_loop.batch_progress.is_last_batch
