"""Gusts: wind that comes and goes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor

from toile.effects.base import ForceEffect, Parameter, Stage, Surroundings
from toile.errors import InputError
from toile.geometry.horizontal import horizontal_axes
from toile.limits import Count


def _parameters(n_modes: int) -> tuple[Parameter, ...]:
    return tuple(
        Parameter(f"{axis}_{k}", "m/s²", -50.0, 50.0, 1.0, f"amplitude of {k} half waves, {what}")
        for axis, what in (
            ("x", "the camera's x axis made horizontal"),
            ("z", "the horizontal one across it"),
        )
        for k in range(1, n_modes + 1)
    )


class Gusts(ForceEffect):
    """Uniform horizontal acceleration Σ a_k cos(π k t / T) over a clip of length T, of zero mean.

    Its mean over the clip is the constant wind of the fit and left to that.

    Args:
        values: see Effect.
        n_modes: per horizontal direction.
    """

    NAME: ClassVar[str] = "gusts"
    STAGE: ClassVar[Stage] = Stage.ACTUATION
    PARAMETERS: ClassVar[tuple[Parameter, ...]] = _parameters(6)
    SOURCE: ClassVar[str] = (
        "wind velocity as a sum of harmonics: Shinozuka and Deodatis, Simulation of Stochastic Processes by "
        "Spectral Representation, Applied Mechanics Reviews 44(4), 1991"
    )

    def __init__(self, values: Mapping[str, float] | None = None, n_modes: Count = 6) -> None:
        if n_modes < 1:
            raise InputError(
                "gusts: too few modes", where="effect=gusts", expected="n_modes >= 1", got=str(n_modes)
            )
        self._parameters = _parameters(n_modes)
        super().__init__(values)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """See Effect."""
        return self._parameters

    def acceleration(self, times: Tensor, around: Surroundings) -> Tensor:
        """See ForceEffect."""
        amplitudes = self.values.reshape(2, -1)
        length = (around.n_frames - 1) / around.fps  # also where fps is a mean
        k = torch.arange(1, amplitudes.shape[1] + 1, dtype=torch.float64)
        modes = torch.cos(torch.pi * k * times[:, None] / length)
        return (modes @ amplitudes.T @ horizontal_axes(around.gravity))[:, None]
