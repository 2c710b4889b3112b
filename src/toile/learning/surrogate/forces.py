"""Random external forces: gravity, wind, and turbulence that varies in space and time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from toile.errors import InputError
from toile.learning.surrogate.distributions import directions, log_uniform, normal, uniform
from toile.learning.surrogate.materials import require_range
from toile.limits import Count, Fraction, NonNegative


class Accelerations(NamedTuple):
    """External accelerations of n cloths in network units.

    Attributes:
        gravity: (n,), its magnitude, the scale of everything else.
        steady: (n, 3), gravity and wind.
        turbulence: (n, k, k, 3), on a coarse grid over the cloth.
        turbulence_strength: (n,), standard deviation of the turbulence over time.
    """

    gravity: Tensor
    steady: Tensor
    turbulence: Tensor
    turbulence_strength: Tensor

    def without_turbulence(self, kept: Tensor) -> Accelerations:
        """The same, turbulence only where kept (n,) is 1 and not 0."""
        return self._replace(
            turbulence=self.turbulence * kept[:, None, None, None],
            turbulence_strength=self.turbulence_strength * kept,
        )


@dataclass(frozen=True)
class ForceSampler:
    """Draws external accelerations and lets the turbulence go on as an Ornstein–Uhlenbeck process.

    Attributes:
        gravity: bounds of its magnitude in network units, log-uniform: g βh² / edge covers all time steps and
            resolutions. The direction is random.
        wind: largest standard deviation of a component of the wind / gravity; uniform from 0.
        turbulence: largest standard deviation of a component of the turbulence / gravity; the square of a
            uniform number makes calm more frequent.
        turbulence_grid: k, vertices of the coarse grid along either side.
        turbulence_persistence: correlation of the turbulence between one step and the next.
    """

    gravity: tuple[NonNegative, NonNegative]
    wind: NonNegative
    turbulence: NonNegative
    turbulence_grid: Count
    turbulence_persistence: Fraction

    def __post_init__(self) -> None:
        require_range("forces.gravity", self.gravity)
        if self.turbulence_grid < 2 or not 0 <= self.turbulence_persistence <= 1:
            raise InputError(
                "The turbulence is unusable",
                where="forces",
                expected="turbulence_grid of at least 2, turbulence_persistence from 0 to 1",
                got=f"{self.turbulence_grid}, {self.turbulence_persistence}",
            )

    def sample(self, n: int, generator: torch.Generator) -> Accelerations:
        """Draw the forces of n cloths."""
        gravity = log_uniform(n, self.gravity, generator)
        down = directions(n, generator) * gravity[:, None]
        wind = normal((n, 3), generator) * (self.wind * uniform(n, generator) * gravity)[:, None]
        strength = self.turbulence * uniform(n, generator).square() * gravity
        shape = (n, self.turbulence_grid, self.turbulence_grid, 3)
        return Accelerations(
            gravity, down + wind, normal(shape, generator) * strength[:, None, None, None], strength
        )

    def next_turbulence(self, turbulence: Tensor, strength: Tensor, generator: torch.Generator) -> Tensor:
        """The turbulence (n, k, k, 3) one step later; its strength (n,) stays."""
        kept = self.turbulence_persistence
        fresh = normal(tuple(turbulence.shape), generator) * strength[:, None, None, None]
        return kept * turbulence + (1 - kept**2) ** 0.5 * fresh


def acceleration_field(steady: Tensor, turbulence: Tensor, grid: tuple[int, int]) -> Tensor:
    """External acceleration of every vertex, (n, H, W, 3): the coarse turbulence interpolated bicubically.

    Args:
        steady: (n, 3).
        turbulence: (n, k, k, 3).
        grid: (H, W).
    """
    fine = torch.nn.functional.interpolate(
        turbulence.permute(0, 3, 1, 2), size=grid, mode="bicubic", align_corners=True
    )
    return steady[:, None, None] + fine.permute(0, 2, 3, 1)
