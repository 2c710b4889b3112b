"""Drift of rest lengths: cloth that shrinks, dries, swells or creeps while it is filmed."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import ClassVar, Self

import torch
from torch import Tensor

from toile.effects.base import Amount, ElementEffect, Parameter, Scope, Stage, Surroundings
from toile.effects.modes import cosine_modes
from toile.errors import InputError
from toile.physics.cloth import Cloth
from toile.physics.elements import Elements
from toile.physics.step_terms import StepContext

_PLACES = ((1, 0), (0, 1))
"""Modes over the cloth, beside the mean."""
_POWERS = (1, 2)
"""Of the time since frame 0."""


class RestLengthDrift(ElementEffect):
    """Rest lengths times exp(Σ a_jm (t / T)^j c_m), along each grid axis for itself; diagonals by the mean.

    At frame 0 all are those of the template. It names no cause: water, heat or creep all do so.
    """

    NAME: ClassVar[str] = "rest_length_drift"
    STAGE: ClassVar[Stage] = Stage.MECHANICS
    SCOPE: ClassVar[Scope] = Scope.CLIP
    past_reach: ClassVar[int] = 0
    PARAMETERS: ClassVar[tuple[Parameter, ...]] = tuple(
        Parameter(
            f"axis_{axis}_{where}_{power}",
            "1",
            -0.3,
            0.3,
            0.01,
            f"logarithm of rest lengths along grid axis {axis}, {what}, with (t / T)^{power}",
        )
        for axis in (0, 1)
        for where, what in (
            ("mean", "mean"),
            *((f"mode_{p}{q}", f"{p} half waves along axis 0, {q} along 1") for p, q in _PLACES),
        )
        for power in _POWERS
    )
    SOURCE: ClassVar[str] = (
        "Sharon and Efrati, The mechanics of non-Euclidean plates, Soft Matter 6, 2010 (growth and shrinkage "
        "as a change of the rest metric)"
    )
    duration: float = 1.0

    def for_clip(self, duration: float) -> Self:
        """See Effect: T is the length of the longest clip [s]."""
        other = copy.copy(self)
        other.duration = duration
        return other

    def amounts(
        self, around: Surroundings, material: Mapping[str, float], times: Tensor
    ) -> tuple[Amount, ...]:
        """See Effect: by how much sides have changed after T, the mean over the cloth."""
        change = torch.expm1(around.cloth.lines.areas() @ self._fields(around.cloth, self.duration))
        return tuple(Amount(f"axis {axis}", 100 * float(change[axis]), "%") for axis in (0, 1))

    def elements(self, elements: Elements, now: StepContext) -> Elements:
        """See ElementTerm."""
        if not self.is_active:
            return elements
        of = now.cloth.energies.named
        edges, diagonals = of("stretching"), of("shearing")
        if now.cloth.grid is None:
            raise InputError(
                "drifting rest lengths need a cloth on a grid",
                where="cloth",
                expected="a grid",
                got="a general mesh",
            )
        along_0 = edges.stencil[:, 1] - edges.stencil[:, 0] == now.cloth.grid[1]
        fields = self._fields(now.cloth, now.time)
        both = fields[edges.stencil].mean(1)
        change = torch.where(along_0, both[:, 0], both[:, 1])
        changed = elements.with_rest(stretching=elements.rest["stretching"] * torch.exp(change))
        if diagonals.stencil.shape[1] != 2:  # angles stay
            return changed
        mean = fields[diagonals.stencil].mean((1, 2))
        return changed.with_rest(shearing=elements.rest["shearing"] * torch.exp(mean))

    def _fields(self, cloth: Cloth, time: float) -> Tensor:
        """Logarithms at the vertices, along grid axis 0 and 1, (N, 2)."""
        places = cosine_modes(cloth, _PLACES)
        places = torch.cat((torch.ones(len(places), 1, dtype=torch.float64), places), 1)
        powers = torch.tensor([(time / self.duration) ** power for power in _POWERS], dtype=torch.float64)
        amplitudes = self.values.reshape(2, -1, len(_POWERS)) @ powers
        found: Tensor = places @ amplitudes.T
        return found
