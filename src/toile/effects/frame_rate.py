"""Frame rate: the clip's clock is not what its file says."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from toile.effects.base import Parameter, Scope, Stage, TimeEffect


class FrameRate(TimeEffect):
    """Time between frames times exp(v)."""

    NAME: ClassVar[str] = "frame_rate"
    STAGE: ClassVar[Stage] = Stage.MECHANICS
    SCOPE: ClassVar[Scope] = Scope.DEVICE
    PARAMETERS: ClassVar[tuple[Parameter, ...]] = (
        Parameter("log_factor", "1", -0.7, 0.7, 0.05, "logarithm of true over nominal time between frames"),
    )
    SOURCE: ClassVar[str] = (
        "Bridgman, Dimensional Analysis, 1922: for a given motion, forces per mass scale with the inverse "
        "square of the time unit"
    )

    def frame_interval(self, interval: Tensor) -> Tensor:
        """See TimeEffect."""
        return interval * torch.exp(self.values[0]) if self.is_active else interval
