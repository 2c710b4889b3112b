"""Which stiffnesses new cloths of the pool have more often: those with which steps fail."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from toile.learning.surrogate.distributions import uniform
from toile.learning.surrogate.materials import MaterialRanges
from toile.limits import Fraction, TwoOrMore

_N_STIFFNESSES = 3


@dataclass(frozen=True)
class Emphasis:
    """Cuts the material box into parts and draws new cloths from them in proportion to their failures.

    Attributes:
        levels: parts of the logarithmic range of each stiffness; the box has their cube.
        corners: share of the cloths with the extreme stiffnesses of their part: bounds of the box, and what
            lies evenly between them.
        evenly: share of the cloths that come from all parts alike.
        memory: of a part's running failure, what is kept when one of its cloths has made a step.
    """

    levels: TwoOrMore
    corners: Fraction
    evenly: Fraction
    memory: Fraction

    def start(self) -> Tensor:
        """Failures of all parts before anything is known, (levels³,)."""
        return torch.ones(self.levels**_N_STIFFNESSES)

    def noted(self, failures: Tensor, box: MaterialRanges, stiffness: Tensor, new: Tensor) -> Tensor:
        """Failures (levels³,) after the steps of some cloths.

        Args:
            failures: before.
            box: the whole.
            stiffness: of the cloths, (B, 3).
            new: their failures, 0 to 1, (B,).
        """
        place = (box.places(stiffness) * self.levels).long().clamp(0, self.levels - 1)
        part = (place * place.new_tensor([self.levels**2, self.levels, 1])).sum(-1)
        count = torch.zeros_like(failures).index_add(0, part, torch.ones_like(new))
        total = torch.zeros_like(failures).index_add(0, part, new)
        kept = self.memory**count
        return kept * failures + (1 - kept) * total / count.clamp(min=1)

    def sample(
        self, n: int, box: MaterialRanges, failures: Tensor, share: float, generator: torch.Generator
    ) -> Tensor:
        """Stiffnesses (n, 3).

        Args:
            n: number of cloths.
            box: the whole.
            failures: of its parts, (levels³,).
            share: of the logarithmic ranges that is used, from the soft end; all places are scaled by it.
            generator: of the random numbers.
        """
        weights = self.evenly / len(failures) + (1 - self.evenly) * failures / failures.sum().clamp(min=1e-12)
        part = torch.multinomial(weights, n, replacement=True, generator=generator)
        place = torch.stack(
            (part // self.levels**2, part // self.levels % self.levels, part % self.levels), -1
        )
        inside = uniform(n * _N_STIFFNESSES, generator).reshape(n, _N_STIFFNESSES)
        extreme = uniform(n, generator) < self.corners
        drawn = torch.where(extreme[:, None], place / (self.levels - 1), (place + inside) / self.levels)
        return box.at(share * drawn)
