"""Motion blur: the shutter is open for a while."""

from __future__ import annotations

from typing import ClassVar

from torch import Tensor

from toile.effects.base import ExposureEffect, Parameter, Scope, Stage


class MotionBlur(ExposureEffect):
    """A frame is the mean of what is seen during a fraction of the frame interval."""

    NAME: ClassVar[str] = "motion_blur"
    STAGE: ClassVar[Stage] = Stage.APPEARANCE
    SCOPE: ClassVar[Scope] = Scope.DEVICE
    PARAMETERS: ClassVar[tuple[Parameter, ...]] = (
        Parameter("fraction", "1", 0.0, 1.0, 0.3, "exposure over frame interval (shutter angle over 360°)"),
    )
    SOURCE: ClassVar[str] = (
        "Potmesil and Chakravarty, Modeling Motion Blur in Computer-Generated Images, SIGGRAPH 1983"
    )

    def exposure(self) -> Tensor:
        """See ExposureEffect."""
        return self.values[0]
