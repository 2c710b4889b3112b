"""Where the lines of a grid lie on its sheet: evenly spaced, or closer to each other near the borders.

A free border curls and flutters at lengths that an even grid of a few hundred vertices does not have, and
what it cannot do there is missing from the motion of the whole cloth. Lines that come closer towards the
borders (as the nodes of Chebyshev's polynomials do) follow it with as many vertices.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor
from torch.nn.functional import pad

Crowding = Annotated[float, Field(ge=0, le=0.9)]
"""See GridLines.crowded."""


@dataclass(frozen=True)
class GridLines:
    """Places of all lines of a grid (H, W).

    Attributes:
        along_0: of the H lines that follow each other along axis 0, rising from 0 to 1.
        along_1: of the W lines along axis 1.
    """

    along_0: tuple[float, ...]
    along_1: tuple[float, ...]

    def __post_init__(self) -> None:
        for name, places in (("along_0", self.along_0), ("along_1", self.along_1)):
            rising = all(b > a for a, b in pairwise(places))
            if len(places) < 2 or places[0] != 0.0 or places[-1] != 1.0 or not rising:
                raise ValueError(f"{name}: expected places that rise from 0 to 1, got {places}")

    @staticmethod
    def even(height: int, width: int) -> GridLines:
        """Evenly spaced lines."""
        return GridLines.crowded(height, width, 0.0)

    @staticmethod
    def crowded(height: int, width: int, crowding: Crowding) -> GridLines:
        """Lines whose distance is less at the borders than in the middle.

        Args:
            height: number of lines H along axis 0.
            width: number of lines W along axis 1.
            crowding: share c of u' = (1 - c) u + c (1 - cos πu) / 2: where lines are closest, at the borders
                of a fine grid, they are 1 - c of the mean distance apart, and in its middle 1 + 0.57 c.
        """
        return GridLines(_crowded(height, crowding), _crowded(width, crowding))

    @property
    def grid(self) -> tuple[int, int]:
        """(H, W)."""
        return len(self.along_0), len(self.along_1)

    @property
    def is_even(self) -> bool:
        """Whether they are evenly spaced."""
        return self == GridLines.even(*self.grid)

    def places(self) -> tuple[Tensor, Tensor]:
        """(H,) and (W,)."""
        first, second = (torch.tensor(p, dtype=torch.float64) for p in (self.along_0, self.along_1))
        return first, second

    def spacings(self) -> tuple[Tensor, Tensor]:
        """Distances between lines (H-1,) and (W-1,), over their mean."""
        first, second = (p.diff() * (len(p) - 1) for p in self.places())
        return first, second

    def shares(self) -> tuple[Tensor, Tensor]:
        """What of the sheet's sides belongs to each line, (H,) and (W,), over the mean distance of lines."""
        first, second = (0.5 * (pad(d, (1, 0)) + pad(d, (0, 1))) for d in self.spacings())
        return first, second

    def areas(self) -> Tensor:
        """Share of the sheet's area that belongs to every vertex (N,)."""
        first, second = self.shares()
        found: Tensor = torch.outer(first, second).reshape(-1) / (first.sum() * second.sum())
        return found

    def strips(self) -> tuple[Tensor, Tensor]:
        """Width of the strip that each line stands for, (H,) and (W,), over the mean distance of lines.

        Half of it lies on either side. A line on a border stands for a whole one, as on an even grid, where
        its threads are as stiff as all others (paper, 3.1).
        """
        first, second = (torch.cat((d[:1], (d[:-1] + d[1:]) / 2, d[-1:])) for d in self.spacings())
        return first, second

    def element_factors(self) -> Mapping[str, Tensor]:
        """Factors on the stiffness of all elements of a grid with which it is the same sheet, by their kind.

        Of an even grid all are 1. A thread of length l that stands for a strip of width b has Y b / l, an
        angle between two such threads B b / l, the angle at a corner of a cell of sides a and b S a b. Strain
        of its diagonals d is a b / d² of the shear angle, half of it in a square, so they have
        S a b (d² / (2 a b))².

        Returns:
            "edges", "corners", "diagonals" and "straights", in the order of grid_stencils and grid_diagonals.
        """
        first, second = (d.numpy() for d in self.spacings())
        strip_0, strip_1 = (s.numpy() for s in self.strips())
        between_0, between_1 = (first[:-1] + first[1:]) / 2, (second[:-1] + second[1:]) / 2
        a, b = first[:, None], second[None]
        area = a * b
        found = {
            "edges": (strip_1 / first[:, None], strip_0[:, None] / second),
            "corners": (area,) * 4,
            "diagonals": (area * ((a * a + b * b) / (2 * area)) ** 2,) * 2,
            "straights": (strip_1 / between_0[:, None], strip_0[:, None] / between_1),
        }
        return {
            name: torch.cat([torch.from_numpy(part).reshape(-1) for part in parts])
            for name, parts in found.items()
        }


def _crowded(n: int, crowding: float) -> tuple[float, ...]:
    even = torch.linspace(0, 1, n, dtype=torch.float64)
    places = (1 - crowding) * even + crowding * (1 - torch.cos(torch.pi * even)) / 2
    return (0.0, *places[1:-1].tolist(), 1.0)
