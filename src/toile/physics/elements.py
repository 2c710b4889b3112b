"""Stiffness factors and rest shape of every element of a cloth, as they are in one step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from torch import Tensor


@dataclass(frozen=True)
class Elements:
    """What effects may change about the elements of each energy, by the energy's name.

    Attributes:
        factors: on all stiffnesses of the energy, (E,).
        rest: rest shape in the energy's own units, (E,) or (E, R); see each energy.
        tensions: of edges that are as long as in the cloth's rest shape (E,) [N]; None where they have none.
    """

    factors: Mapping[str, Tensor]
    rest: Mapping[str, Tensor]
    tensions: Tensor | None = None

    def scaled(self, **by: Tensor | float) -> Elements:
        """With the factors of some energies multiplied by (E,) or a number."""
        return replace(self, factors={**self.factors, **{n: self.factors[n] * f for n, f in by.items()}})

    def with_rest(self, **shapes: Tensor) -> Elements:
        """With other rest shapes for some energies."""
        return replace(self, rest={**self.rest, **shapes})
