"""Pressure: more of it on one side of the cloth than on the other, whatever makes it."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import ClassVar, Self

import torch
from torch import Tensor

from toile.effects.base import Amount, Parameter, Scope, Stage, Surroundings, VertexEffect
from toile.effects.gusts import USUAL_MODES, half_waves
from toile.physics.step_terms import StepContext


def _parameters(n_modes: int) -> tuple[Parameter, ...]:
    return tuple(
        Parameter(f"wave_{k}", "m/s²", -50.0, 50.0, 1.0, f"amplitude of {k} half waves, along the normals")
        for k in range(n_modes + 1)
    )


class Pressure(VertexEffect):
    """Force per mass n Σ a_k cos(π k t / T) along the normals n, alike all over the cloth.

    As fast as gusts may be, and T the length of the longest clip. Normals are those at the step's begin, so
    that the potential is linear in the new positions. It names no cause: air enclosed behind the cloth, or a
    fan that it is pressed against, push so; wind pushes along the normals too, but as hard as it is across
    them.
    """

    NAME: ClassVar[str] = "pressure"
    STAGE: ClassVar[Stage] = Stage.ACTUATION
    SCOPE: ClassVar[Scope] = Scope.CLIP
    quadratic: ClassVar[bool] = True
    past_reach: ClassVar[int] = 1
    own_past: ClassVar[bool] = True
    PARAMETERS: ClassVar[tuple[Parameter, ...]] = _parameters(USUAL_MODES)
    SOURCE: ClassVar[str] = "Batchelor, An Introduction to Fluid Dynamics, 1967 (normal stress of a fluid)"
    duration: float = 1.0

    def __init__(self, values: Mapping[str, float] | None = None) -> None:
        self._parameters = _parameters(USUAL_MODES)
        super().__init__(values)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """See Effect."""
        return self._parameters

    def for_clip(self, duration: float) -> Self:
        """See Effect: waves up to the frequency that gusts have; amplitudes stay as they are."""
        acting = self.values.nonzero().flatten().tolist()
        n_modes = max([half_waves(duration), *acting])
        values = self.values.new_zeros(n_modes + 1)
        n_kept = min(len(values), len(self.values))
        values[:n_kept] = self.values[:n_kept]
        other = copy.copy(self)
        other.duration = duration
        other._parameters = _parameters(n_modes)
        return other.with_values(values)

    def amounts(
        self, around: Surroundings, material: Mapping[str, float], times: Tensor
    ) -> tuple[Amount, ...]:
        """See Effect: mean over the clip, and deviation in time; along the normals, see StepContext.normals.

        Per mass of an area, as images do not say what a cloth weighs. The mean is hardly told apart from a
        steady wind.
        """
        over_time = self._waves(times) @ self.values
        return (
            Amount("mean", float(over_time.mean()), "m/s²"),
            Amount("deviation in time", float(over_time.std(correction=0)), "m/s²"),
        )

    def energy(self, positions: Tensor, now: StepContext) -> Tensor:
        """See VertexTerm."""
        time = torch.tensor([now.time], dtype=torch.float64)
        acceleration = self._waves(time)[0] @ self.values
        along = (now.normals * (positions - now.positions)).sum(-1)
        return -now.cloth.masses * acceleration * along

    def force_derivatives(self, positions: Tensor, now: StepContext) -> Tensor:
        """See VertexEffect."""
        waves = self._waves(torch.tensor([now.time], dtype=torch.float64))[0]
        return waves[:, None, None] * (now.cloth.masses[:, None] * now.normals)

    def _waves(self, times: Tensor) -> Tensor:
        """Of every parameter at times (T,), (T, n_parameters)."""
        k = torch.arange(len(self._parameters), dtype=torch.float64)
        return torch.cos(torch.pi * k * times[:, None] / self.duration)
