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

    def sample(self, n: int, generator: torch.Generator, share: float = 1.0) -> Tensor:
        """Stiffnesses (n, 3): Y, S, B; of the logarithmic ranges only a share, from the soft end."""
        bounds = [(low, low * (high / low) ** share) for low, high in self._bounds]
        return torch.stack([log_uniform(n, b, generator) for b in bounds], -1)

    def at(self, places: Tensor) -> Tensor:
        """Stiffnesses (n, 3) at places (n, 3) in the box: 0 at the soft bound, 1 at the stiff one."""
        low, high = places.new_tensor(self._bounds).unbind(-1)
        return low * (high / low) ** places

    def places(self, stiffness: Tensor) -> Tensor:
        """Inverse of at; 0 where a range has no extent."""
        low, high = stiffness.new_tensor(self._bounds).unbind(-1)
        return (stiffness / low).log() / (high / low).log().clamp(min=1e-12)

    @property
    def _bounds(self) -> tuple[tuple[float, float], ...]:
        return (self.stretching, self.shearing, self.bending)


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
