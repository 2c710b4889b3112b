"""Lens distortion: straight lines seen curved."""

from __future__ import annotations

from typing import ClassVar

from torch import Tensor

from toile.effects.base import CameraEffect, Parameter, Scope, Stage
from toile.geometry.camera import Camera


class LensDistortion(CameraEffect):
    """Distance r from the principal point, as a tangent of the viewing angle, times 1 + k₁ r² + k₂ r⁴."""

    NAME: ClassVar[str] = "lens_distortion"
    STAGE: ClassVar[Stage] = Stage.CAMERA
    SCOPE: ClassVar[Scope] = Scope.DEVICE
    PARAMETERS: ClassVar[tuple[Parameter, ...]] = (
        Parameter("k1", "1", -1.0, 1.0, 0.1, "second order; negative is a barrel"),
        Parameter("k2", "1", -2.0, 2.0, 0.1, "fourth order"),
    )
    SOURCE: ClassVar[str] = (
        "Brown, Close-Range Camera Calibration, Photogrammetric Engineering 37(8), 1971 (radial terms)"
    )

    def pixels(self, pixels: Tensor, camera: Camera) -> Tensor:
        """See CameraEffect."""
        if not self.is_active:
            return pixels
        away = pixels - pixels.new_tensor((camera.cx, camera.cy))
        squared = (away / away.new_tensor((camera.fx, camera.fy))).square().sum(-1, keepdim=True)
        k1, k2 = self.values.to(pixels.dtype)
        return pixels + away * (k1 * squared + k2 * squared.square())
