"""What a setting may be, written where it is declared: types with bounds and units.

A constructor says ``areal_density: Annotated[Positive, Unit("kg/m²")]``; the command line checks every value
of the configuration against such annotations before anything is built, and says name, expected and got. A
bound has this one home: code that is called from Python with wrong numbers is not slowed down by it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from pydantic import Field


@dataclass(frozen=True)
class Unit:
    """Unit of a setting, for messages.

    Attributes:
        name: e.g. "kg/m²".
    """

    name: str


Finite = Annotated[float, Field(allow_inf_nan=False)]
"""Any number that is neither nan nor infinite."""

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
"""A finite number above 0."""

NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
"""A finite number, 0 or above."""

Fraction = Annotated[float, Field(ge=0, le=1)]
"""A number from 0 to 1."""

Count = Annotated[int, Field(ge=1)]
"""A whole number, 1 or above."""

CountOrZero = Annotated[int, Field(ge=0)]
"""A whole number, 0 or above."""

Seed = Annotated[int, Field(ge=0, lt=2**63)]
"""A seed of random numbers."""

TwoOrMore = Annotated[int, Field(ge=2)]
"""A whole number, 2 or above."""

Level = Annotated[int, Field(ge=0, le=255)]
"""A level of an 8-bit picture."""
