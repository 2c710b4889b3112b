"""Random flat cloths: rest lengths that scatter as those of measured templates do."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from toile.errors import InputError
from toile.learning.surrogate.distributions import normal, rotations, uniform
from toile.limits import NonNegative


class RestShapes(NamedTuple):
    """Cloths in one of their resting poses, all in network units.

    Attributes:
        positions: (n, H, W, 3) float64, flat, randomly oriented, centroid 0.
        rest_lengths_i: (n, H-1, W), of the edges between rows.
        rest_lengths_j: (n, H, W-1), of the edges between columns.
    """

    positions: Tensor
    rest_lengths_i: Tensor
    rest_lengths_j: Tensor


@dataclass(frozen=True)
class RestShapeSampler:
    """Grids of unit spacing whose vertices are displaced within their plane, and the edges measured on them.

    So stretching has no energy at the start (paper: "random resting poses"), with any scatter of the edges.

    Attributes:
        scatter: largest relative standard deviation of the rest lengths; each cloth has its own, uniform
            between 0 and this. Templates scatter by 2 to 5 %.
    """

    scatter: NonNegative

    def __post_init__(self) -> None:
        if not 0 <= self.scatter < 0.2:
            raise InputError(
                "The scatter of the rest lengths is unusable",
                where="rest_shapes.scatter",
                expected="a number from 0 to 0.2, above which edges may vanish",
                got=str(self.scatter),
            )

    def sample(self, n: int, grid: tuple[int, int], generator: torch.Generator) -> RestShapes:
        """Draw n cloths of a grid (H, W)."""
        height, width = grid
        device = generator.device
        rows, columns = torch.meshgrid(
            torch.arange(height, device=device), torch.arange(width, device=device), indexing="ij"
        )
        flat = torch.stack((rows, columns, torch.zeros_like(rows)), -1).double()
        # Both ends of an edge move, hence the root.
        deviation = self.scatter * uniform(n, generator) / 2**0.5
        displacement = normal((n, height, width, 3), generator).clamp(-3, 3) * deviation[:, None, None, None]
        displacement[..., 2] = 0
        shape = flat + displacement
        shape = shape - shape.mean((1, 2), keepdim=True)
        # Sums of products, not matrix products: those lose digits under mixed precision.
        turned = (shape[..., None, :] * rotations(n, generator)[:, None, None]).sum(-1)
        return RestShapes(
            turned,
            (shape[:, 1:] - shape[:, :-1]).norm(dim=-1).float(),
            (shape[:, :, 1:] - shape[:, :, :-1]).norm(dim=-1).float(),
        )
