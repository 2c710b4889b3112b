"""Exponential average of the weights over the steps: what is validated, and exported in the end."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import WeightAveraging
from torch import Tensor

from toile.physics.surrogate.surrogate import Surrogate

if TYPE_CHECKING:
    from toile.learning.surrogate.module import SurrogateTraining

Tensors = tuple[Tensor, ...] | list[Tensor]


class AverageSurrogate(WeightAveraging):
    """An average that follows the weights slowly, and quickly at the beginning.

    Lightning's EMAWeightAveraging has one decay for the whole run; here the share that is kept rises to it.
    During the validation, and when the run has ended, the average takes the place of the weights.

    Args:
        decay: share of the average that is kept in a step; (1 + n) / (10 + n) in the first steps n, where
            that is less.
    """

    def __init__(self, decay: float) -> None:
        super().__init__(use_buffers=False, multi_avg_fn=self._average)
        self.decay = decay

    @property
    def surrogate(self) -> Surrogate:
        """The averaged network; there once the run has started."""
        assert self._average_model is not None
        return cast("SurrogateTraining", self._average_model.module).surrogate

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Copy the network to where it will be trained."""
        self._device = trainer.strategy.root_device
        super().setup(trainer, pl_module, stage)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Follow the weights, unless the step was left out."""
        if not cast("SurrogateTraining", pl_module).step_left_out:
            super().on_train_batch_end(trainer, pl_module, outputs, batch, batch_idx)

    @torch.no_grad()
    def _average(self, averages: Tensors, weights: Tensors, n_averaged: Tensor | int) -> None:
        n = int(n_averaged)
        decay = min(self.decay, (1 + n) / (10 + n))
        for average, weight in zip(averages, weights, strict=True):
            average.lerp_(weight, 1 - decay)
