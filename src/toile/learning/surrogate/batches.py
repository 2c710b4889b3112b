"""The pool as a Lightning data module: batches of its cloths."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import torch
from lightning import LightningDataModule
from torch import Tensor

from toile.learning.surrogate.pool import Pool
from toile.learning.surrogate.settings import TrainingSettings


class PoolBatches(LightningDataModule):
    """Draws the cloths of every step from the pool.

    With several processes (DDP) each has its own part of the pool with its own random numbers, and draws its
    share of the batch. Checkpoints hold the pools of all processes. Resumed with another number of processes,
    the surplus pools are dropped and the missing ones begin anew.

    Args:
        settings: how to train.
        seed: of the pool.

    Attributes:
        pool: of this process; there once the run has started.
    """

    def __init__(self, settings: TrainingSettings, seed: int) -> None:
        super().__init__()
        self.settings = settings
        self.seed = seed
        self.pool: Pool

    def setup(self, stage: str) -> None:
        """Fill the pool of this process; Lightning restores a checkpoint afterwards."""
        trainer: Any = self.trainer
        # Far apart, so that runs with neighbouring seeds share no pool.
        seed = self.seed + 1_000_003 * trainer.global_rank
        generator = torch.Generator(trainer.strategy.root_device).manual_seed(seed)
        size = _share(self.settings.pool.size, trainer.world_size)
        share = self.settings.stiffness_share_at(0)
        self.pool = Pool(replace(self.settings.pool, size=size), generator, share)

    def train_dataloader(self) -> Draws:
        """One epoch of steps."""
        trainer: Any = self.trainer
        size = _share(self.settings.batch_size, trainer.world_size)
        return Draws(self.pool, size, self.settings.steps_per_epoch)

    def val_dataloader(self) -> range:
        """One rollout after every epoch, of cloths that are not those of the pool."""
        return range(1)

    def state_dict(self) -> dict[str, Any]:
        """States of the pools of all processes; only the first process gets the others'."""
        trainer: Any = self.trainer
        own = self.pool.state_dict()
        if trainer.world_size == 1:
            return {"pools": [own]}
        gathered: list[Any] = [None] * trainer.world_size
        torch.distributed.gather_object(own, gathered if trainer.is_global_zero else None, dst=0)
        return {"pools": gathered if trainer.is_global_zero else [own]}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Inverse of state_dict, for the pool of this process.

        Raises:
            InputError: the state is that of another size or grid.
        """
        trainer: Any = self.trainer
        if trainer.global_rank < len(state_dict["pools"]):
            self.pool.load_state_dict(state_dict["pools"][trainer.global_rank])


class Draws:
    """Indices (B,) of the cloths of every step of an epoch, drawn when they are asked for.

    A DataLoader would warn about missing worker processes. Lightning takes any iterable with a length, and
    lets one that has a state go on in the middle of an epoch.

    Args:
        pool: of this process.
        size: cloths per step.
        n_steps: steps per epoch.
    """

    def __init__(self, pool: Pool, size: int, n_steps: int) -> None:
        self._pool = pool
        self._size = size
        self._n_steps = n_steps

    def __len__(self) -> int:
        return self._n_steps

    def __iter__(self) -> Iterator[Tensor]:
        return (self._pool.draw(self._size) for _ in range(self._n_steps))

    def state_dict(self) -> dict[str, Any]:
        """Nothing: what is drawn next follows from the pool, which PoolBatches stores."""
        return {}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Inverse of state_dict."""


def _share(total: int, n: int) -> int:
    """What each of n processes gets of something, rounded up."""
    return -(-total // n)
