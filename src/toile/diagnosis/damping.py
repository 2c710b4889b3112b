"""Damping of Gauss-Newton steps (Levenberg 1944, Marquardt 1963), in prior precisions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from toile.limits import Count, Positive

Factor = Annotated[float, Field(gt=1, allow_inf_nan=False)]
"""A factor by which something grows."""


@dataclass(frozen=True)
class Damping:
    """How steps are damped where all of the way does not lower the cost.

    Attributes:
        tried: steps of a pass that are tried, each with more damping.
        first: damping of the first step that has any [prior precisions].
        stronger: factor by which it grows after a step that did not lower the cost.
        weaker: by which it falls after one that did.
    """

    tried: Count = 5
    first: Positive = 10.0
    stronger: Factor = 5.0
    weaker: Factor = 4.0

    def more(self, damping: float) -> float:
        """Damping after a step that did not lower the cost."""
        return max(self.stronger * damping, self.first)

    def less(self, damping: float) -> float:
        """Damping after a step that did."""
        return damping / self.weaker if damping > self.first / self.weaker else 0.0
