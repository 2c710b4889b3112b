"""When a cloth of the pool is replaced by a new one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from toile.learning.surrogate.distributions import uniform
from toile.limits import Fraction, NonNegative, Positive, Unit


class Resets(NamedTuple):
    """Which of B cloths to replace, (B,) bool each, by the first reason that holds."""

    diverged: Tensor
    old: Tensor
    random: Tensor

    @property
    def any(self) -> Tensor:
        """All of them, (B,) bool."""
        return self.diverged | self.old | self.random


@dataclass(frozen=True)
class ResetRules:
    """Limits beyond which a cloth no longer teaches anything.

    Attributes:
        residual: mean out-of-balance force / mean external force (paper: "if the physics-based loss of a
            sample becomes too high").
        strain: on top of it, mean out-of-balance force / stretching stiffness: what a stiff cloth answers to
            a displacement that nobody sees is no reason.
        extent: distance of a coordinate from the centroid, in grid spacings.
        probability: of a reset for no reason, per step of a cloth (paper: "from time to time").
    """

    residual: Positive
    strain: NonNegative
    extent: Annotated[Positive, Unit("edge lengths")]
    probability: Fraction

    def apply(
        self,
        positions: Tensor,
        residual: Tensor,
        forces: Tensor,
        stretching: Tensor,
        age: Tensor,
        longest: int | None,
        generator: torch.Generator,
    ) -> Resets:
        """Decide.

        Args:
            positions: (B, H, W, 3), after the step.
            residual: mean length of the out-of-balance force, (B,).
            forces: mean length of the external force, (B,).
            stretching: Y, (B,).
            age: (B,), steps since the start, this one included.
            longest: age from which a cloth is too old, None for no limit.
            generator: of the random resets.
        """
        extent = (positions - positions.mean((1, 2), keepdim=True)).abs().amax((1, 2, 3))
        # Written so that NaN counts as diverged.
        limit = self.residual * forces + self.strain * stretching
        diverged = ~((residual <= limit) & (extent <= self.extent))
        too_old = torch.zeros_like(diverged) if longest is None else age >= longest
        old = too_old & ~diverged
        chance = uniform(len(positions), generator) < self.probability
        return Resets(diverged, old, chance & ~diverged & ~old)


def relative_residual(residual: Tensor, forces: Tensor) -> Tensor:
    """Mean length of the out-of-balance force / mean length of the external force.

    Args:
        residual: (..., H, W, 3).
        forces: (..., H, W, 3).

    Returns:
        (...,), without unit.
    """
    return mean_length(residual) / mean_length(forces).clamp(min=1e-12)


def mean_length(vectors: Tensor) -> Tensor:
    """Mean length of vectors (..., H, W, 3) over the cloth, (...,)."""
    return vectors.norm(dim=-1).mean((-1, -2))
