"""Steady forces: a smooth field over the cloth that does not change, whatever makes it."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import ClassVar

import torch
from torch import Tensor

from toile.effects.base import Amount, ForceEffect, Parameter, Scope, Stage, Surroundings
from toile.effects.modes import cosine_modes, modes_up_to

HALF_WAVES = 3
"""Along each axis of the cloth, of the shortest mode."""


@lru_cache
def _parameters() -> tuple[Parameter, ...]:
    return tuple(
        Parameter(
            f"{axis}_{p}{q}",
            "m/s²",
            -50.0,
            50.0,
            # Eddies of half the size push about half as hard.
            1.0 / (p + q),
            f"amplitude along the {axis} axis, {p} half waves along grid axis 0, {q} along 1",
        )
        for axis in "xyz"
        for p, q in modes_up_to(HALF_WAVES)
    )


class SteadyForces(ForceEffect):
    """Acceleration Σ a_m c_m(u), in the camera's axes, with smooth cosine modes c_m of zero mean.

    Its mean over the cloth is the constant wind of the fit and left to that. It names no cause: a vortex, a
    draught through a slit or a magnet all make such a field.
    """

    NAME: ClassVar[str] = "steady_forces"
    STAGE: ClassVar[Stage] = Stage.ACTUATION
    SCOPE: ClassVar[Scope] = Scope.CLIP
    PARAMETERS: ClassVar[tuple[Parameter, ...]] = _parameters()
    SOURCE: ClassVar[str] = (
        "Kennedy and O'Hagan, Bayesian calibration of computer models, Journal of the Royal Statistical "
        "Society B 63(3), 2001 (a discrepancy of its own, here a force)"
    )

    def amounts(
        self, around: Surroundings, material: Mapping[str, float], times: Tensor
    ) -> tuple[Amount, ...]:
        """See Effect: root mean square of the field over the cloth."""
        field = self.acceleration(torch.zeros(1, dtype=torch.float64), around)[0]
        mean_square = around.cloth.lines.areas() @ field.square().sum(-1)
        return (Amount("root mean square", float(mean_square.sqrt()), "m/s²"),)

    def acceleration(self, times: Tensor, around: Surroundings) -> Tensor:
        """See ForceEffect."""
        modes = cosine_modes(around.cloth, modes_up_to(HALF_WAVES))
        field: Tensor = modes @ self.values.reshape(3, -1).T
        return field.expand(len(times), -1, -1)
