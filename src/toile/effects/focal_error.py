"""Focal error: a focal length that is not what the calibration says."""

from __future__ import annotations

from typing import ClassVar

from torch import Tensor

from toile.effects.base import CameraEffect, Parameter, Scope, Stage
from toile.geometry.camera import Camera


class FocalError(CameraEffect):
    """Both focal lengths times 1 + v."""

    NAME: ClassVar[str] = "focal_error"
    STAGE: ClassVar[Stage] = Stage.CAMERA
    SCOPE: ClassVar[Scope] = Scope.DEVICE
    PARAMETERS: ClassVar[tuple[Parameter, ...]] = (
        Parameter("relative", "1", -0.3, 0.3, 0.02, "true over nominal focal length, minus 1"),
    )
    SOURCE: ClassVar[str] = (
        "Hartley and Zisserman, Multiple View Geometry in Computer Vision, 2nd edition 2004, section 6.1"
    )

    def pixels(self, pixels: Tensor, camera: Camera) -> Tensor:
        """See CameraEffect."""
        if not self.is_active:
            return pixels
        centre = pixels.new_tensor((camera.cx, camera.cy))
        return pixels + self.values[0].to(pixels.dtype) * (pixels - centre)
