"""Named parameters and their columns: the one place that says which number of a vector is which."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import torch
from torch import Tensor

T = TypeVar("T")


@dataclass(frozen=True)
class Parameter:
    """One number that a model depends on.

    Attributes:
        name: as in configurations, tables and curves.
        symbol: as in formulas.
        unit: SI; "" for a pure number.
        lower, upper: what it may be; both are allowed.
        default: what it is unless said otherwise; None where it must be said.
    """

    name: str
    symbol: str
    unit: str
    lower: float = 0.0
    upper: float = float("inf")
    default: float | None = None

    @property
    def label(self) -> str:
        """Name and unit, as on an axis."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name


@dataclass(frozen=True)
class ParameterVector(Sequence[Parameter]):
    """Parameters in the order of their columns; no name appears twice.

    Attributes:
        parameters: one per column.
    """

    parameters: tuple[Parameter, ...]

    def __post_init__(self) -> None:
        names = [p.name for p in self.parameters]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"parameters: expected every name once, got {', '.join(twice)} twice")

    @property
    def names(self) -> tuple[str, ...]:
        """Names in the order of the columns."""
        return tuple(p.name for p in self.parameters)

    def index(self, name: object, start: int = 0, stop: int | None = None) -> int:
        """Column of a parameter.

        Raises:
            KeyError: there is none of that name.
        """
        try:
            return self.names.index(str(name), start, len(self) if stop is None else stop)
        except ValueError:
            raise KeyError(f"no parameter {name!r}; there are {', '.join(self.names) or 'none'}") from None

    def pack(self, values: Mapping[str, Tensor]) -> Tensor:
        """Vector (..., P) of values (...) by name, with the defaults of those that are not given.

        Raises:
            KeyError: a name without a default is missing, or one is too many.
        """
        defaults = {p.name: p.default for p in self if p.default is not None and p.name not in values}
        if {*values, *defaults} != set(self.names):
            raise KeyError(f"expected values of {', '.join(self.names)}, got {', '.join(values)}")
        like = next(iter(values.values()), torch.zeros((), dtype=torch.float64))
        columns = {**values, **{name: torch.full_like(like, value) for name, value in defaults.items()}}
        return torch.stack([columns[name] for name in self.names], -1)

    def with_defaults(self, defaults: Mapping[str, float]) -> ParameterVector:
        """The same with other defaults.

        Raises:
            KeyError: there is no such parameter.
            ValueError: a default is outside its bounds.
        """
        changed = list(self.parameters)
        for name, value in defaults.items():
            index = self.index(name)
            changed[index] = replace(changed[index], default=value)
            if not changed[index].lower <= value <= changed[index].upper:
                raise ValueError(
                    f"{name}: expected {changed[index].lower:g} to {changed[index].upper:g}, got {value:g}"
                )
        return ParameterVector(tuple(changed))

    def unpack(self, vector: Sequence[T]) -> dict[str, T]:
        """Entries of a vector by name."""
        return dict(zip(self.names, vector, strict=True))

    def violations(self, vector: Sequence[float]) -> list[str]:
        """What is outside its bounds or not a number, one line each."""
        return [
            f"{p.name}: expected {p.lower:g} to {p.upper:g} {p.unit}".rstrip() + f", got {float(value):g}"
            for p, value in zip(self.parameters, vector, strict=True)
            if not p.lower <= float(value) <= p.upper
        ]

    def __len__(self) -> int:
        return len(self.parameters)

    def __iter__(self) -> Iterator[Parameter]:
        return iter(self.parameters)

    def __getitem__(self, index):  # type: ignore[no-untyped-def]
        return self.parameters[index]
