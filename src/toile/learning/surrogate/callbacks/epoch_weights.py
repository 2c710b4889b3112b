"""The averaged weights after every epoch, from which the best can be chosen on cloths of one's own."""

from __future__ import annotations

from pathlib import Path
from typing import Any, final

from lightning import Callback, LightningModule, Trainer

from toile.learning.surrogate.module import SurrogateTraining
from toile.physics.surrogate.weights import save_weights


@final
class EpochWeights(Callback):
    """Writes ``epoch_<number>.pt`` into a folder after every validation.

    Args:
        folder: where to write.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)

    def on_validation_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        """Write; within the validation, the average has taken the place of the weights."""
        assert isinstance(pl_module, SurrogateTraining)
        if trainer.is_global_zero:
            number = pl_module.epochs_done
            self.folder.mkdir(parents=True, exist_ok=True)
            description = {"epoch": str(number), "steps": str(pl_module.steps_done)}
            save_weights(self.folder / f"epoch_{number:03d}.pt", pl_module.surrogate, description)
