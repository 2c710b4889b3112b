"""Which corners are pinned, and how they are moved about."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from toile.errors import InputError
from toile.learning.surrogate.distributions import normal, uniform
from toile.limits import Fraction, NonNegative

N_CORNERS = 4
_SWEEPS = 3  # pulling one pair together pushes the next apart; a few rounds settle it


@dataclass(frozen=True)
class PinnedCornerSampler:
    """Pinned corners and their velocities, an Ornstein–Uhlenbeck process.

    Corners go round the cloth: (0, 0), (0, W-1), (H-1, W-1), (H-1, 0).

    Attributes:
        shares: of cloths with 0, 1, 2 and 4 pinned corners; two are neighbours.
        speed: largest standard deviation of a velocity component / root of gravity, in network units; the
            square of a uniform number makes rest more frequent.
        individual: of the speed, what each corner has for itself beside the motion they share.
        persistence: correlation of the velocities between one step and the next.
    """

    shares: tuple[Fraction, Fraction, Fraction, Fraction]
    speed: NonNegative
    individual: NonNegative
    persistence: Fraction

    def __post_init__(self) -> None:
        good = len(self.shares) == 4 and min(self.shares) >= 0 and abs(sum(self.shares) - 1) < 1e-6
        if not good or not 0 <= self.persistence <= 1:
            raise InputError(
                "The pinned corners are unusable",
                where="pinned_corners",
                expected="four shares that sum to 1, persistence from 0 to 1",
                got=f"{self.shares}, {self.persistence}",
            )

    def sample_pinned(self, n: int, generator: torch.Generator) -> Tensor:
        """Whether each corner is pinned, (n, 4) bool."""
        bounds = torch.tensor(self.shares, device=generator.device).cumsum(0)[:-1]
        kind = torch.bucketize(uniform(n, generator), bounds, right=True)
        count = torch.tensor((0, 1, 2, 4), device=generator.device)[kind]
        first = torch.randint(0, N_CORNERS, (n,), generator=generator, device=generator.device)
        place = (torch.arange(N_CORNERS, device=generator.device) - first[:, None]) % N_CORNERS
        return place < count[:, None]

    def sample_speed(self, gravity: Tensor, generator: torch.Generator) -> Tensor:
        """Standard deviation (n,) of the common velocity for gravity of a magnitude (n,)."""
        return self.speed * uniform(len(gravity), generator).square() * gravity.sqrt()

    def sample_velocities(self, speed: Tensor, generator: torch.Generator) -> Tensor:
        """Velocities (n, 4, 3) per step of the corners, for speeds (n,)."""
        n = len(speed)
        common, own = normal((n, 1, 3), generator), normal((n, N_CORNERS, 3), generator)
        return (common + self.individual * own) * speed[:, None, None]

    def next_velocities(self, velocities: Tensor, speed: Tensor, generator: torch.Generator) -> Tensor:
        """The velocities one step later."""
        kept = self.persistence
        return kept * velocities + (1 - kept**2) ** 0.5 * self.sample_velocities(speed, generator)


def corner_indices(grid: tuple[int, int]) -> tuple[list[int], list[int]]:
    """Rows and columns of the corners, in the order used here."""
    height, width = grid
    return [0, 0, height - 1, height - 1], [0, width - 1, width - 1, 0]


def border_lengths(rest_lengths_i: Tensor, rest_lengths_j: Tensor) -> Tensor:
    """Rest length (n, 4) of the border from each corner to the next."""
    top, bottom = rest_lengths_j[:, 0].sum(-1), rest_lengths_j[:, -1].sum(-1)
    left, right = rest_lengths_i[:, :, 0].sum(-1), rest_lengths_i[:, :, -1].sum(-1)
    return torch.stack((top, right, bottom, left), -1)


def within_reach(corners: Tensor, pinned: Tensor, lengths: Tensor) -> Tensor:
    """Move neighbouring pinned corners together where the border between them is too short.

    A stiff cloth would otherwise be torn, which no video shows.

    Args:
        corners: (n, 4, 3), positions.
        pinned: (n, 4) bool.
        lengths: (n, 4), of the border from each corner to the next.

    Returns:
        Positions (n, 4, 3); corners that are free are as they were.
    """
    place = list(corners.unbind(1))
    for a in [*range(N_CORNERS)] * _SWEEPS:
        b = (a + 1) % N_CORNERS
        apart = place[a] - place[b]
        distance = apart.norm(dim=-1).clamp(min=1e-6)
        excess = (1 - lengths[:, a] / distance).clamp(min=0) * (pinned[:, a] & pinned[:, b])
        shift = 0.5 * excess[:, None] * apart
        place[a], place[b] = place[a] - shift, place[b] + shift
    return torch.stack(place, 1)
