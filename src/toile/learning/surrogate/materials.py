"""Random stiffness."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from toile.errors import InputError
from toile.learning.surrogate.distributions import log_uniform
from toile.limits import Positive


@dataclass(frozen=True)
class MaterialRanges:
    """Stiffnesses in network units, log-uniform between two bounds: they span orders of magnitude.

    Attributes:
        stretching: bounds of Y.
        shearing: bounds of S.
        bending: bounds of B.
    """

    stretching: tuple[Positive, Positive]
    shearing: tuple[Positive, Positive]
    bending: tuple[Positive, Positive]

    def __post_init__(self) -> None:
        for field in fields(self):
            require_range(f"materials.{field.name}", getattr(self, field.name))

    def sample(self, n: int, generator: torch.Generator) -> Tensor:
        """Stiffnesses (n, 3): Y, S, B."""
        bounds = (self.stretching, self.shearing, self.bending)
        return torch.stack([log_uniform(n, b, generator) for b in bounds], -1)


def require_range(where: str, bounds: tuple[float, float]) -> None:
    """Refuse bounds from which nothing can be drawn log-uniformly.

    Raises:
        InputError: not two positive numbers in ascending order.
    """
    if len(bounds) != 2 or not 0 < bounds[0] <= bounds[1] < float("inf"):
        raise InputError(
            "A range of random numbers is unusable",
            where=where,
            expected="two positive numbers, the smaller one first",
            got=str(bounds),
        )
