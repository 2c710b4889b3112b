"""The training cycle as a Lightning module (paper, section 3.1.5)."""

from __future__ import annotations

import math
import time
from typing import Any

import torch
from lightning import LightningModule
from lightning.pytorch.utilities.types import OptimizerLRScheduler
from torch import Tensor
from torch.optim.lr_scheduler import LambdaLR

from toile.errors import InputError
from toile.learning.surrogate.batches import PoolBatches
from toile.learning.surrogate.energies import energies_by_term
from toile.learning.surrogate.objectives import Progress, Turn
from toile.learning.surrogate.pool import Pool
from toile.learning.surrogate.resets import Resets, mean_length, relative_residual
from toile.learning.surrogate.settings import TrainingSettings
from toile.learning.surrogate.validation import validation_rollout
from toile.physics.surrogate.surrogate import Surrogate

STATE = "toile_training"
"""Key in Lightning's checkpoint."""
_SHOWN = 64  # cloths of the pool whose energies are measured


class SurrogateTraining(LightningModule):
    """Trains the network on the pool's problems, one batch a step; needs no data.

    Draw a batch of cloth states, let the network propose a step, descend along the gradient of Eq. 4 rescaled
    per sample, store the result of the step in the pool, and replace what went wrong. The gradients of the
    passes of a step do not depend on each other; they are added, and clipped together.

    A run resumed from a checkpoint ends with the same bits as one that was never interrupted. With several
    processes (DDP) gradients are averaged; see ``PoolBatches`` for their pools.

    Mixed precision (``bf16-mixed``) reaches the convolutions only: pool and physics consist of operations
    that stay in float32. Half precision with loss scaling is not supported.

    Args:
        surrogate: the network, already initialised.
        settings: how to train.

    Attributes:
        seconds: time spent in steps and validations, over all resumes.
        history: one row of plain numbers per complete epoch.
        measures: plain numbers of the last step.
        step_left_out: whether the last step had a gradient that is not finite, and did nothing.
        validation: relative out-of-balance force (steps, cloths) of the last validation rollout, None before.
    """

    def __init__(self, surrogate: Surrogate, settings: TrainingSettings) -> None:
        super().__init__()
        # The layout in which convolutions on the CPU are fastest.
        self.surrogate = surrogate.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.settings = settings
        self.seconds = 0.0
        self.history: list[dict[str, float]] = []
        self.measures: dict[str, float] = {}
        self.step_left_out = False
        self.validation: Tensor | None = None
        self._sums: dict[str, float] = {}
        self._started = 0.0

    def on_fit_start(self) -> None:
        """Refuse settings of the trainer that would change what is counted.

        Raises:
            InputError: there is one.
        """
        needed = {
            "max_epochs": self.settings.epochs,
            "max_steps": -1,
            "limit_train_batches": 1.0,
            "limit_val_batches": 1.0,
            "val_check_interval": 1.0,
            "check_val_every_n_epoch": 1,
            "accumulate_grad_batches": 1,
            "gradient_clip_val": None,
        }
        for name, value in needed.items():
            got = getattr(self.trainer, name)
            if got != value:
                raise InputError(
                    "The training cannot run like this",
                    where=f"trainer.{name}",
                    expected=f"{value}: length, validation and gradients are settings of the training",
                    got=str(got),
                )

    def configure_optimizers(self) -> OptimizerLRScheduler:
        """Adam, as in the paper, and the learning rate of every step."""
        settings = self.settings
        optimizer = torch.optim.Adam(self.surrogate.parameters(), lr=1.0, betas=settings.adam_betas)
        scheduler = LambdaLR(
            optimizer, lambda k: settings.learning_rate.at(k, settings.steps_per_epoch, settings.n_steps)
        )
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}

    def training_step(self, batch: Tensor, batch_idx: int) -> Tensor:
        """One turn of the cycle.

        Args:
            batch: indices (B,) of cloths of the pool.
            batch_idx: of the step in the epoch.

        Returns:
            A number whose gradient is that of the rescaled Eq. 4; its value means nothing.
        """
        self._started = time.perf_counter()
        settings, pool = self.settings, self.pool
        schedule: Any = self.lr_schedulers()
        self.measures = {"learning rate": schedule.get_last_lr()[0]}
        progress = Progress(self.steps_done, settings.n_steps)
        pool.share = settings.stiffness_share_at(progress.step)
        turn = settings.objective.turn(self.surrogate, pool, batch, settings.n_passes, progress)
        self.measures |= turn.measures
        resets = self._reset(batch, turn)
        self.measures |= {"gradient norm": 0.0, "skipped steps": 0.0}  # as the backward pass will tell
        self.measures |= {f"resets/{why}": float(which.sum()) for why, which in resets._asdict().items()}
        return turn.loss

    def configure_gradient_clipping(
        self,
        optimizer: torch.optim.Optimizer,
        gradient_clip_val: float | None = None,
        gradient_clip_algorithm: str | None = None,
    ) -> None:
        """Shorten a gradient that is too long; one that is not finite leaves the step out."""
        norm = float(torch.nn.utils.clip_grad_norm_(self.surrogate.parameters(), self.settings.gradient_norm))
        # The same in all processes: the gradients are averaged by now.
        self.step_left_out = not math.isfinite(norm)
        if self.step_left_out:
            optimizer.zero_grad()  # Adam passes over what has no gradient.
        self.measures |= {
            "gradient norm": 0.0 if self.step_left_out else norm,
            "skipped steps": float(self.step_left_out),
        }
        for name, value in self.measures.items():
            self._sums[name] = self._sums.get(name, 0.0) + value
        self.log_dict({f"step/{_tag(name)}": value for name, value in self.measures.items()})
        self.log("step", self.steps_done + 1.0)
        self.seconds += time.perf_counter() - self._started

    def on_train_batch_end(self, outputs: Any, batch: Any, batch_idx: int) -> None:
        """Where the run stops within an epoch, leave out the validation that Lightning would still do."""
        if self.trainer.should_stop and self.steps_done % self.settings.steps_per_epoch:
            self.trainer.limit_val_batches = 0  # The history has rows of complete epochs only.

    def on_validation_epoch_start(self) -> None:
        """Start the clock."""
        self._started = time.perf_counter()

    def validation_step(self, batch: int, batch_idx: int) -> None:
        """Move cloths by the network alone; by now it has the averaged weights."""
        settings = self.settings
        self.validation = validation_rollout(self.surrogate, settings.pool, settings.validation, self.device)

    def on_validation_epoch_end(self) -> None:
        """Add a row to the history."""
        assert self.validation is not None
        n, pool, finite = self.settings.steps_per_epoch, self.pool, self.validation.nan_to_num(nan=torch.inf)
        row = {"epoch": float(self.epochs_done), "steps": float(self.steps_done)}
        row |= {name: total / n for name, total in self._sums.items()}
        self._sums = {}
        first = torch.arange(min(_SHOWN, pool.settings.size), device=pool.generator.device)
        for name, energy in energies_by_term(pool.states.take(first)).items():
            row[f"energy/{name}"] = float(energy.mean())
        row["pool age/mean"] = float(pool.states.age.float().mean())
        row["pool age/largest"] = float(pool.states.age.max())
        row["validation residual/median"] = float(finite.median())
        row["validation residual/0.9"] = float(finite.quantile(0.9))
        self.seconds += time.perf_counter() - self._started
        row["seconds"] = self.seconds
        self.history.append(row)
        shown = {f"epoch/{_tag(name)}": row[name] for name in row if name not in ("epoch", "steps")}
        self.log_dict({**shown, "step": row["steps"]}, sync_dist=True)

    @property
    def pool(self) -> Pool:
        """The pool of this process, once the run has started."""
        batches: Any = self.trainer.datamodule  # type: ignore[attr-defined]
        assert isinstance(batches, PoolBatches)
        return batches.pool

    @property
    def steps_done(self) -> int:
        """Number of complete steps."""
        return self.trainer.global_step

    @property
    def epochs_done(self) -> int:
        """Complete epochs."""
        return self.steps_done // self.settings.steps_per_epoch

    @property
    def finished(self) -> bool:
        """Whether all steps are done."""
        return self.steps_done >= self.settings.n_steps

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add what Lightning does not know of: plain numbers, lists and dictionaries."""
        checkpoint[STATE] = {
            "seconds": self.seconds,
            "history": [dict(row) for row in self.history],
            "sums": dict(self._sums),
        }

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Inverse of on_save_checkpoint; Lightning restores the rest."""
        state = checkpoint[STATE]
        self.seconds = float(state["seconds"])
        self.history = [dict(row) for row in state["history"]]
        self._sums = dict(state["sums"])

    @torch.no_grad()
    def _reset(self, indices: Tensor, turn: Turn) -> Resets:
        """Replace what has diverged, is too old, or had bad luck."""
        settings, pool = self.settings, self.pool
        length = settings.rollout_length
        resets = settings.resets.apply(
            turn.positions,
            mean_length(turn.residual),
            mean_length(turn.forces),
            pool.states.stiffness[indices, 0],
            pool.states.age[indices],
            None if length is None else length.at(self.steps_done, settings.n_steps),
            pool.generator,
        )
        # From 0 to 1, whatever the stiffness multiplies it by.
        relative = relative_residual(turn.residual, turn.forces)
        pool.note_failures(indices, torch.where(resets.diverged, 1.0, relative / (1 + relative)))
        pool.reset(indices[resets.any])
        return resets


def _tag(name: str) -> str:
    """Name of a curve in TensorBoard."""
    return name.replace(" ", "_")
