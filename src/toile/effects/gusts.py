"""Gusts: wind that comes and goes."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from typing import ClassVar, Self

import torch
from torch import Tensor

from toile.effects.base import Amount, ForceEffect, Parameter, Scope, Stage, Surroundings
from toile.errors import InputError
from toile.geometry.horizontal import horizontal_axes
from toile.limits import Count

USUAL_MODES = 6
"""Per horizontal direction, where neither a number is given nor the length of the clips is known."""

HIGHEST = 3.0
"""Frequency [Hz] up to which clips have modes where their number is not given."""


def _parameters(n_modes: int, longest: int = 1) -> tuple[Parameter, ...]:
    """Of ``longest`` to ``n_modes`` half waves; 0 is the mean."""
    return tuple(
        Parameter(
            f"{axis}_{k}",
            "m/s²",
            -50.0,
            50.0,
            1.0,
            f"{f'amplitude of {k} half waves' if k else 'mean'}, {what}",
        )
        for axis, what in (
            ("x", "the camera's x axis made horizontal"),
            ("z", "the horizontal one across it"),
        )
        for k in range(longest, n_modes + 1)
    )


def half_waves(duration: float) -> int:
    """How many of them, one at least, reach HIGHEST in so long a clip [s]."""
    # A product such as 6 × 1.5 s may come out a hair above the whole number.
    return max(1, math.ceil(2 * HIGHEST * duration - 1e-6))


class Gusts(ForceEffect):
    """Uniform horizontal acceleration Σ a_k cos(π k t / T) over a clip of length T, of zero mean.

    Its mean over the clip is the constant wind of the fit and left to that; in still air there is none, and
    the mean is a mode of its own, k = 0 (``in_still_air``). k half waves have the frequency k / (2 T), so a
    number of modes that is enough for a short clip is too small for a long one.

    Args:
        values: see Effect.
        n_modes: per horizontal direction; None for 6, or as many as ``for_clip`` finds.

    Raises:
        InputError: there are no modes, or values of others.
    """

    NAME: ClassVar[str] = "gusts"
    STAGE: ClassVar[Stage] = Stage.ACTUATION
    SCOPE: ClassVar[Scope] = Scope.CLIP
    PARAMETERS: ClassVar[tuple[Parameter, ...]] = _parameters(USUAL_MODES)
    SOURCE: ClassVar[str] = (
        "wind velocity as a sum of harmonics: Shinozuka and Deodatis, Simulation of Stochastic Processes by "
        "Spectral Representation, Applied Mechanics Reviews 44(4), 1991"
    )

    def __init__(self, values: Mapping[str, float] | None = None, n_modes: Count | None = None) -> None:
        if n_modes is not None and n_modes < 1:
            raise InputError(
                "gusts: too few modes", where="effect=gusts", expected="n_modes >= 1", got=str(n_modes)
            )
        self._given = n_modes is not None
        self._longest = 1
        self._parameters = _parameters(USUAL_MODES if n_modes is None else n_modes)
        super().__init__(values)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """See Effect."""
        return self._parameters

    def for_clip(self, duration: float) -> Self:
        """See Effect: modes up to 3 Hz where no number of them was given; amplitudes stay as they are."""
        if self._given:
            return self
        amplitudes = self.values.reshape(2, -1)
        acting = [k + self._longest for k in range(amplitudes.shape[1]) if bool(amplitudes[:, k].any())]
        n_modes = max([half_waves(duration), *acting])
        values = amplitudes.new_zeros(2, n_modes + 1 - self._longest)
        n_kept = min(values.shape[1], amplitudes.shape[1])
        values[:, :n_kept] = amplitudes[:, :n_kept]
        other = copy.copy(self)
        other._parameters = _parameters(n_modes, self._longest)
        return other.with_values(values.reshape(-1))

    def in_still_air(self) -> Self:
        """See Effect: with a mean, which acts in clips whose Surroundings say so."""
        if not self._longest:
            return self
        amplitudes = self.values.reshape(2, -1)
        other = copy.copy(self)
        other._longest = 0
        other._parameters = _parameters(amplitudes.shape[1], 0)
        return other.with_values(torch.cat((amplitudes.new_zeros(2, 1), amplitudes), 1).reshape(-1))

    def amounts(
        self, around: Surroundings, material: Mapping[str, float], times: Tensor
    ) -> tuple[Amount, ...]:
        """See Effect: the strongest that blows at a frame, beside the clip's wind."""
        strongest = self.acceleration(times, around).norm(dim=-1).max()
        return (Amount("strongest gust", float(strongest), "m/s²"),)

    def acceleration(self, times: Tensor, around: Surroundings) -> Tensor:
        """See ForceEffect."""
        amplitudes = self.values.reshape(2, -1)
        length = (around.n_frames - 1) / around.fps  # also where fps is a mean
        k = self._longest + torch.arange(amplitudes.shape[1], dtype=torch.float64)
        modes = torch.cos(torch.pi * k * times[:, None] / length)
        if not self._longest and not around.still_air:
            # The wind of the fit has it.
            modes = modes * (k > 0)
        return (modes @ amplitudes.T @ horizontal_axes(around.gravity))[:, None]
