"""Motion of the pinned vertices: smooth functions of time, at rest at t = 0."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Annotated, final

import torch
from torch import Tensor

from toile.limits import NonNegative, Positive, Unit


class PinnedMotion(ABC):
    """How all pinned vertices move together; displacement and velocity are zero at t = 0."""

    @abstractmethod
    def displacement(self, times: Tensor) -> Tensor:
        """Displacement from the initial position (T, 3) [m] at times (T,) >= 0 [s], float64."""


@final
@dataclass(frozen=True)
class Still(PinnedMotion):
    """Pinned vertices that do not move."""

    def displacement(self, times: Tensor) -> Tensor:
        """See PinnedMotion."""
        return times.new_zeros(len(times), 3)


@final
@dataclass(frozen=True)
class Swing(PinnedMotion):
    """To and fro between the initial position and another: d(t) = a (1 - cos 2πt/T) / 2.

    Attributes:
        amplitude: a, displacement at the turning point [m].
        period: T [s].
    """

    amplitude: tuple[float, float, float] = (0.0, 0.0, 0.08)
    period: Annotated[Positive, Unit("s")] = 1.2

    def displacement(self, times: Tensor) -> Tensor:
        """See PinnedMotion."""
        phase = 0.5 * (1 - torch.cos(2 * math.pi * times / self.period))
        return phase[:, None] * torch.tensor(self.amplitude, dtype=times.dtype)


@final
@dataclass(frozen=True)
class Shake(PinnedMotion):
    """Sinusoidal shaking that fades in: d(t) = a s(t / T_in) sin 2πft, s(x) = 3x² - 2x³ up to x = 1, then 1.

    Attributes:
        amplitude: a [m].
        frequency: f [Hz].
        fade_in: T_in [s].
    """

    amplitude: tuple[float, float, float] = (0.015, 0.0, 0.03)
    frequency: Annotated[Positive, Unit("1/s")] = 2.0
    fade_in: Annotated[NonNegative, Unit("s")] = 0.25

    def displacement(self, times: Tensor) -> Tensor:
        """See PinnedMotion."""
        x = (times / self.fade_in).clamp(0, 1)
        phase = x * x * (3 - 2 * x) * torch.sin(2 * math.pi * self.frequency * times)
        return phase[:, None] * torch.tensor(self.amplitude, dtype=times.dtype)
