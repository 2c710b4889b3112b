"""What changes over a training run: learning rate and length of the rollouts, as functions of the step.

They have no state, so there is nothing to restore when a run continues.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

from toile.limits import Count, CountOrZero, Fraction, NonNegative, Positive


class LearningRate(ABC):
    """Learning rate over the steps."""

    @abstractmethod
    def at(self, step: int, steps_per_epoch: int, n_steps: int) -> float:
        """The rate of step 0, 1, ..., n_steps - 1."""


@dataclass(frozen=True)
class Stairs(LearningRate):
    """Constant, multiplied by a factor after some epochs (paper: 10⁻³, × 0.2 after 25 and 50 epochs).

    Attributes:
        initial: rate of the first epoch.
        factor: at every stair.
        epochs: complete epochs before each stair.
    """

    initial: Positive
    factor: Positive
    epochs: tuple[Count, ...]

    def at(self, step: int, steps_per_epoch: int, n_steps: int) -> float:
        """The rate of a step."""
        return self.initial * self.factor ** sum(step >= e * steps_per_epoch for e in self.epochs)


@dataclass(frozen=True)
class WarmCosine(LearningRate):
    """Linear rise, then the peak, then half a cosine down.

    Attributes:
        peak: highest rate.
        warm_up: steps of the rise.
        hold: share of the run after which the descent begins.
        final: rate of the last step / peak.
    """

    peak: Positive
    warm_up: CountOrZero
    hold: Fraction
    final: NonNegative

    def at(self, step: int, steps_per_epoch: int, n_steps: int) -> float:
        """The rate of a step."""
        rise = min(1.0, (step + 1) / max(1, self.warm_up))
        begin = self.hold * n_steps
        share = min(1.0, max(0.0, (step - begin) / max(1.0, n_steps - 1 - begin)))
        descent = self.final + (1 - self.final) * 0.5 * (1 + math.cos(math.pi * share))
        return self.peak * rise * descent


@dataclass(frozen=True)
class RolloutLength:
    """Longest age of a cloth before it starts again: short at first, when the network cannot do much yet.

    Attributes:
        first: steps at the beginning of the run.
        last: steps from ``share`` of the run on; it grows linearly in between.
        share: of the run.
    """

    first: Count
    last: Count
    share: Fraction

    def at(self, step: int, n_steps: int) -> int:
        """Longest age in a step."""
        progress = min(1.0, step / max(1.0, self.share * n_steps))
        return round(self.first + (self.last - self.first) * progress)


@dataclass(frozen=True)
class StiffnessShare:
    """Share of the logarithmic stiffness ranges that new cloths have: stiff ones come later.

    Attributes:
        first: share at the beginning of the run, from the soft end.
        until: share of the run after which the ranges are whole; the share grows linearly until then.
    """

    first: Fraction
    until: Fraction

    def at(self, step: int, n_steps: int) -> float:
        """The share in a step."""
        progress = min(1.0, step / max(1.0, self.until * n_steps))
        return self.first + (1.0 - self.first) * progress


@dataclass(frozen=True)
class UnrolledSteps:
    """Time steps through which a gradient goes: one, and one more after each of some shares of the run.

    Attributes:
        after: shares of the run, ascending.
    """

    after: tuple[Fraction, ...]

    def at(self, step: int, n_steps: int) -> int:
        """The number in a step."""
        return 1 + sum(step >= share * n_steps for share in self.after)
