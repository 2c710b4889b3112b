"""Exponential average of the weights over the steps: what is exported in the end."""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor
from torch.optim.swa_utils import AveragedModel

from toile.physics.surrogate.surrogate import Surrogate

Tensors = tuple[Tensor, ...] | list[Tensor]


class AverageSurrogate(AveragedModel):
    """A copy of the network that follows its weights slowly, and quickly at the beginning.

    Lightning's callback for this would average the whole module and swap its weights in and out; as a part of
    the module the copy is simply stored and restored with it.

    Args:
        surrogate: the network that is trained.
        decay: share of the average that is kept in a step; (1 + n) / (10 + n) in the first steps n, where
            that is less.
    """

    def __init__(self, surrogate: Surrogate, decay: float) -> None:
        self.decay = decay
        super().__init__(surrogate, multi_avg_fn=self._average)
        # It never gets gradients; several processes must not wait for them.
        self.requires_grad_(False)

    @property
    def surrogate(self) -> Surrogate:
        """The averaged network."""
        return cast(Surrogate, self.module)

    @torch.no_grad()
    def _average(self, averages: Tensors, weights: Tensors, n_averaged: Tensor | int) -> None:
        n = int(n_averaged)
        decay = min(self.decay, (1 + n) / (10 + n))
        for average, weight in zip(averages, weights, strict=True):
            average.lerp_(weight, 1 - decay)
