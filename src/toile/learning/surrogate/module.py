"""The training cycle as a Lightning module (paper, section 3.1.5)."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from typing import Any

import torch
from lightning import LightningModule
from torch import Tensor

from toile.learning.surrogate.average import AverageSurrogate
from toile.learning.surrogate.energies import energies_by_term
from toile.learning.surrogate.pool import Pool
from toile.learning.surrogate.resets import Resets, mean_length, relative_residual
from toile.learning.surrogate.settings import TrainingSettings
from toile.learning.surrogate.validation import validation_rollout
from toile.physics.surrogate.surrogate import Pass, Surrogate

STATE = "toile_training"
"""Key in Lightning's checkpoint."""
_SHOWN = 64  # cloths of the pool whose energies are measured


class SurrogateTraining(LightningModule):
    """Trains the network on the pool's problems, one batch a step; needs no data.

    Draw a batch of cloth states, let the network propose a step, descend along the gradient of Eq. 4 rescaled
    per sample, store the result of the step in the pool, and replace what went wrong. Optimisation is manual:
    every pass of the network over a step has a backward of its own, so that only one graph is kept at a
    time.

    A step is the unit of everything that is counted here; a run is one Lightning epoch, and "epoch" below
    means ``settings.steps_per_epoch`` steps. A checkpoint written between two steps holds weights, average,
    optimiser, pool and random numbers; a run resumed from it ends with the same bits as one that was never
    interrupted.

    With several processes (DDP) each has its own part of the pool with its own random numbers, and takes its
    share of the batch; gradients are averaged. Checkpoints hold the pools of all processes. Resumed with
    another number of processes, the surplus pools are dropped and the missing ones begin anew.

    Mixed precision (``bf16-mixed``) reaches the convolutions only: pool and physics consist of operations
    that stay in float32. Half precision with loss scaling is not supported.

    Args:
        surrogate: the network, already initialised.
        settings: how to train.
        seed: of the pool.

    Attributes:
        average: exponential average of the weights.
        pool: of this process, None before the start.
        steps_done: number of complete steps.
        seconds: time spent in them, over all resumes.
        history: one row of plain numbers per complete epoch.
        measures: plain numbers of the last step.
        validation: relative out-of-balance force (steps, cloths) of the last validation rollout, None before.
    """

    def __init__(self, surrogate: Surrogate, settings: TrainingSettings, seed: int) -> None:
        super().__init__()
        self.automatic_optimization = False
        # The layout in which convolutions on the CPU are fastest.
        self.surrogate = surrogate.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.average = AverageSurrogate(surrogate, settings.average_decay)
        self.settings = settings
        self.seed = seed
        self.pool: Pool | None = None
        self.steps_done = 0
        self.seconds = 0.0
        self.history: list[dict[str, float]] = []
        self.measures: dict[str, float] = {}
        self.validation: Tensor | None = None
        self._sums: dict[str, float] = {}

    def setup(self, stage: str) -> None:
        """Fill the pool of this process; Lightning restores a checkpoint afterwards."""
        n = self.trainer.world_size
        device = self.trainer.strategy.root_device
        # Far apart, so that runs with neighbouring seeds share no pool.
        generator = torch.Generator(device).manual_seed(self.seed + 1_000_003 * self.global_rank)
        self.pool = Pool(replace(self.settings.pool, size=_share(self.settings.pool.size, n)), generator)

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """Adam, as in the paper; the step sets its learning rate."""
        return torch.optim.Adam(self.surrogate.parameters(), lr=1.0, betas=self.settings.adam_betas)

    def training_step(self, batch: int, batch_idx: int) -> None:
        """One turn of the cycle."""
        started = time.perf_counter()
        settings, pool = self.settings, self.running_pool
        optimizer: Any = self.optimizers()
        rate = settings.learning_rate.at(self.steps_done, settings.steps_per_epoch, settings.n_steps)
        for group in optimizer.param_groups:
            group["lr"] = rate
        indices = pool.draw(_share(settings.batch_size, self.trainer.world_size))
        problem = pool.problem(indices)
        optimizer.zero_grad()
        measures = {"learning rate": rate}
        last: Pass | None = None
        for number, last in enumerate(self.surrogate.passes(problem, settings.n_passes), 1):
            self.manual_backward((last.gradient * last.correction).sum() / (len(indices) * settings.n_passes))
            measures |= _pass_measures(number, last, problem.forces)
        assert last is not None
        norm = float(torch.nn.utils.clip_grad_norm_(self.surrogate.parameters(), settings.gradient_norm))
        # The same in all processes: the gradients are averaged by now.
        usable = math.isfinite(norm)
        if usable:
            optimizer.step()
            self.average.update_parameters(self.surrogate)
        pool.advance(indices, last.positions)
        resets = self._reset(indices, last, problem.forces)
        measures |= {
            "gradient norm": norm if usable else 0.0,
            "skipped steps": float(not usable),
            "resets/diverged": float(resets.diverged.sum()),
            "resets/old": float(resets.old.sum()),
            "resets/random": float(resets.random.sum()),
        }
        self._count(measures, started)

    @property
    def running_pool(self) -> Pool:
        """The pool, once the run has started."""
        if self.pool is None:
            raise RuntimeError("the pool is filled when the training starts")
        return self.pool

    @property
    def epochs_done(self) -> int:
        """Complete epochs."""
        return self.steps_done // self.settings.steps_per_epoch

    @property
    def at_epoch_end(self) -> bool:
        """Whether the last step was the last of an epoch."""
        return self.steps_done > 0 and self.steps_done % self.settings.steps_per_epoch == 0

    @property
    def finished(self) -> bool:
        """Whether all steps are done."""
        return self.steps_done >= self.settings.n_steps

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add everything the next step depends on: plain tensors, numbers, lists and dictionaries."""
        # Steps are counted here; the loop's own counters would disagree after a stop within its epoch.
        checkpoint.pop("loops", None)
        checkpoint[STATE] = {
            "pools": self._all_pools(),
            "steps_done": self.steps_done,
            "seconds": self.seconds,
            "history": [dict(row) for row in self.history],
            "sums": dict(self._sums),
            "seed": self.seed,
        }

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Inverse of on_save_checkpoint; Lightning restores weights, average and optimiser."""
        state = checkpoint[STATE]
        self.steps_done = int(state["steps_done"])
        self.seconds = float(state["seconds"])
        self.history = [dict(row) for row in state["history"]]
        self._sums = dict(state["sums"])
        self.seed = int(state["seed"])
        if self.pool is not None and self.global_rank < len(state["pools"]):
            self.pool.load_state_dict(state["pools"][self.global_rank])

    @torch.no_grad()
    def _reset(self, indices: Tensor, last: Pass, forces: Tensor) -> Resets:
        """Replace what has diverged, is too old, or had bad luck."""
        settings, pool = self.settings, self.running_pool
        length = settings.rollout_length
        resets = settings.resets.apply(
            last.positions,
            mean_length(last.residual),
            mean_length(forces),
            pool.states.stiffness[indices, 0],
            pool.states.age[indices],
            None if length is None else length.at(self.steps_done, settings.n_steps),
            pool.generator,
        )
        pool.reset(indices[resets.any])
        return resets

    def _count(self, measures: dict[str, float], started: float) -> None:
        self.measures = measures
        for name, value in measures.items():
            self._sums[name] = self._sums.get(name, 0.0) + value
        self.steps_done += 1
        before = self.seconds
        self.seconds = before + time.perf_counter() - started
        if self.at_epoch_end:
            self._end_epoch()
            self.seconds = before + time.perf_counter() - started

    def _end_epoch(self) -> None:
        """Add a row to the history; the first process does the measuring."""
        n = self.settings.steps_per_epoch
        row = {"epoch": float(self.epochs_done), "steps": float(self.steps_done)}
        row |= {name: total / n for name, total in self._sums.items()}
        self._sums = {}
        if self.trainer.is_global_zero:
            pool = self.running_pool
            first = torch.arange(min(_SHOWN, pool.settings.size), device=pool.generator.device)
            for name, energy in energies_by_term(pool.states.take(first)).items():
                row[f"energy/{name}"] = float(energy.mean())
            row["pool age/mean"] = float(pool.states.age.float().mean())
            row["pool age/largest"] = float(pool.states.age.max())
            self.validation = validation_rollout(
                self.average.surrogate, self.settings.pool, self.settings.validation, self.device
            )
            finite = self.validation.nan_to_num(nan=torch.inf)
            row["validation residual/median"] = float(finite.median())
            row["validation residual/0.9"] = float(finite.quantile(0.9))
        row["seconds"] = self.seconds
        self.history.append(row)

    def _all_pools(self) -> list[dict[str, Any]]:
        """States of the pools of all processes; only the first process gets the others'."""
        own = self.running_pool.state_dict()
        if self.trainer.world_size == 1:
            return [own]
        gathered: list[Any] = [None] * self.trainer.world_size
        first = self.trainer.is_global_zero
        torch.distributed.gather_object(own, gathered if first else None, dst=0)
        return gathered if first else [own]


def _share(total: int, n: int) -> int:
    """What each of n processes gets of something, rounded up."""
    return -(-total // n)


@torch.no_grad()
def _pass_measures(number: int, result: Pass, forces: Tensor) -> dict[str, float]:
    """Plain numbers of one pass."""
    residual = relative_residual(result.residual, forces).nan_to_num(nan=1e6).clamp(max=1e6)
    change = result.potential_change.nan_to_num(nan=0.0).clamp(-1e6, 1e6)
    values = torch.stack(
        (
            change.median(),
            result.accepted.float().mean(),
            residual.quantile(0.1),
            residual.median(),
            residual.quantile(0.9),
        )
    )
    names = ("potential change", "accepted", "residual 0.1", "residual 0.5", "residual 0.9")
    return {f"pass {number}/{name}": v for name, v in zip(names, values.tolist(), strict=True)}
