"""All settings of a training run."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from pydantic import Field

from toile.errors import InputError
from toile.learning.surrogate.objectives import Objective, PassesApart
from toile.learning.surrogate.pool import PoolSettings
from toile.learning.surrogate.resets import ResetRules
from toile.learning.surrogate.schedules import LearningRate, RolloutLength, StiffnessShare
from toile.learning.surrogate.validation import ValidationSettings
from toile.limits import Count, Fraction, Positive


@dataclass(frozen=True)
class TrainingSettings:
    """How to train; see ``SurrogateTraining`` for the cycle.

    Attributes:
        widths: channels of the network's levels, finest first.
        epochs: length of the run.
        steps_per_epoch: steps between two validations; the paper does not state its own.
        batch_size: cloths per step, drawn from the pool; of all processes together.
        n_passes: passes of the network per step, each with a gradient of its own.
        learning_rate: over the run.
        adam_betas: of the Adam optimiser.
        gradient_norm: longest gradient; a longer one is shortened.
        average_decay: of the exponential average of the weights.
        rollout_length: longest age of a cloth over the run; None for no limit.
        pool: the cloths; its size is that of all processes together.
        resets: when a cloth is replaced.
        validation: after every epoch.
        objective: what a step descends along.
        stiffness_share: of the stiffness ranges over the run; None for the whole ranges.
    """

    widths: Annotated[tuple[Count, ...], Field(min_length=1)]
    epochs: Count
    steps_per_epoch: Count
    batch_size: Count
    n_passes: Count
    learning_rate: LearningRate
    adam_betas: tuple[Fraction, Fraction]
    gradient_norm: Positive
    average_decay: Fraction
    rollout_length: RolloutLength | None
    pool: PoolSettings
    resets: ResetRules
    validation: ValidationSettings
    objective: Objective = field(default_factory=PassesApart)
    stiffness_share: StiffnessShare | None = None

    def __post_init__(self) -> None:
        for name in ("epochs", "steps_per_epoch", "batch_size", "n_passes"):
            if getattr(self, name) < 1:
                raise InputError(
                    "The training is unusable",
                    where=f"training.{name}",
                    expected="at least 1",
                    got=str(getattr(self, name)),
                )
        if self.batch_size > self.pool.size:
            raise InputError(
                "The training is unusable",
                where="training.batch_size",
                expected=f"at most the size of the pool, {self.pool.size}",
                got=str(self.batch_size),
            )

    @property
    def n_steps(self) -> int:
        """Steps of the whole run."""
        return self.epochs * self.steps_per_epoch

    def stiffness_share_at(self, step: int) -> float:
        """Share of the stiffness ranges that new cloths have in a step."""
        return 1.0 if self.stiffness_share is None else self.stiffness_share.at(step, self.n_steps)
