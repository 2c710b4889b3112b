"""Smooth fields over a grid: products of cosines, the eigenmodes of the Laplacian with free borders."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import ClassVar, Self

import numpy as np
import torch
from torch import Tensor

from toile.effects.base import Amount, Effect, Parameter, Surroundings
from toile.errors import InputError
from toile.limits import Count
from toile.physics.cloth import Cloth
from toile.physics.grid_lines import GridLines

# Half waves along grid axis 0 and 1. All have zero mean over the area.
MODES = ((1, 0), (0, 1), (1, 1), (2, 0), (0, 2))

_ENDS = (0.05, 0.95)
"""Shares of the cloth up to which a field is low, and from which on it is high."""

IN_DETAIL = 3
"""Half waves along an axis that resolve a third of the cloth: a print, a wet spot, a worn place."""


def modes_up_to(half_waves: int) -> tuple[tuple[int, int], ...]:
    """All modes of up to so many half waves along each axis, the longest waves first."""
    upto = range(half_waves + 1)
    return tuple(
        sorted(((p, q) for p in upto for q in upto if p + q), key=lambda mode: (sum(mode), -mode[0]))
    )


@lru_cache
def mode_parameters(
    low: float, high: float, scale: float, what: str, modes: tuple[tuple[int, int], ...] = MODES
) -> tuple[Parameter, ...]:
    """One parameter per mode, a pure number."""
    return tuple(
        Parameter(f"mode_{p}{q}", "1", low, high, scale, f"{what}, {p} half waves along axis 0, {q} along 1")
        for p, q in modes
    )


def cosine_modes(cloth: Cloth, modes: Sequence[tuple[int, int]] = MODES) -> Tensor:
    """Modes cos(pπu) cos(qπv) at the vertices, (N, n), u and v from 0 to 1 along grid axis 0 and 1."""
    if cloth.grid is None:
        raise InputError(
            "smooth modes need a cloth on a grid", where="cloth", expected="a grid", got="a general mesh"
        )
    return _on_grid(cloth.lines, tuple(modes))


@lru_cache(maxsize=8)
def _on_grid(lines: GridLines, modes: tuple[tuple[int, int], ...]) -> Tensor:
    """The same for a grid; derivatives by differences ask for it thousands of times."""
    u, v = (torch.pi * places for places in lines.places())
    found = [torch.cos(p * u)[:, None] * torch.cos(q * v)[None, :] for p, q in modes]
    return torch.stack(found, -1).reshape(-1, len(modes))


class SmoothField(Effect):
    """An effect whose values are amplitudes of smooth modes over the cloth.

    Args:
        values: see Effect.
        half_waves: along each axis, of the shortest mode; None for the five longest modes, or as many as
            ``in_detail`` takes.

    Raises:
        InputError: there are no such modes, or values of others.
    """

    ALONG_EACH: ClassVar[tuple[float, float, float, str]]
    """Lowest and highest amplitude, its prior deviation, and what it is an amplitude of."""
    ENDS: ClassVar[tuple[str, str]]
    """What the places are with the lowest and with the highest values."""

    def __init__(self, values: Mapping[str, float] | None = None, half_waves: Count | None = None) -> None:
        # Names of modes have one digit for each axis.
        if half_waves is not None and not 1 <= half_waves <= 9:
            raise InputError(
                f"{self.NAME}: no such modes",
                where=f"effect={self.NAME}",
                expected="half_waves from 1 to 9",
                got=str(half_waves),
            )
        self._given = half_waves is not None
        self.modes = MODES if half_waves is None else modes_up_to(half_waves)
        super().__init__(values)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """See Effect."""
        return mode_parameters(*self.ALONG_EACH, self.modes)

    def in_detail(self) -> Self:
        """See Effect: three half waves along each axis where no number of them was given."""
        if self._given:
            return self
        other = copy.copy(self)
        other.modes = modes_up_to(IN_DETAIL)
        values = self.values.new_zeros(len(other.modes))
        values[[other.modes.index(mode) for mode in self.modes]] = self.values
        return other.with_values(values)

    def acts_on(self, around: Surroundings, motion: Tensor) -> Tensor:
        """See Effect: by how much the field differs from that of most of the cloth."""
        field = self.field(around.cloth)
        return (field - field.median()).abs()

    def amounts(
        self, around: Surroundings, material: Mapping[str, float], times: Tensor
    ) -> tuple[Amount, ...]:
        """See Effect: the twentieths of the cloth with the lowest and the highest values, against usual."""
        field = self.field(around.cloth)
        order = torch.argsort(field)
        # Lines of the grid may be closer at the borders, where smooth fields have their extremes.
        shares = around.cloth.lines.areas()[order]
        up_to = torch.cumsum(shares, 0) - shares / 2
        ends = np.interp(_ENDS, up_to.numpy(), field[order].detach().numpy())
        changes = (100 * np.expm1(ends)).tolist()
        return tuple(Amount(what, change, "%") for what, change in zip(self.ENDS, changes, strict=True))

    def field(self, cloth: Cloth) -> Tensor:
        """The field at the vertices (N,)."""
        return cosine_modes(cloth, self.modes) @ self.values
