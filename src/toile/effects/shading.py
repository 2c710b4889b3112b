"""Shading: cloth that turns towards the light gets brighter."""

from __future__ import annotations

from typing import ClassVar

from torch import Tensor

from toile.effects.base import BrightnessEffect, Parameter, Scope, Stage


class Shading(BrightnessEffect):
    """Factor 1 + <s, n - n₀> on the colour.

    First order of Lambert's law under one distant light and ambient light, (A + D <l, n>) / (A + D <l, n₀>)
    for s = D l / (A + D <l, n₀>), with the one s for the whole cloth; no shadows.
    """

    NAME: ClassVar[str] = "shading"
    STAGE: ClassVar[Stage] = Stage.APPEARANCE
    SCOPE: ClassVar[Scope] = Scope.DEVICE
    PARAMETERS: ClassVar[tuple[Parameter, ...]] = tuple(
        Parameter(axis, "1", -2.0, 2.0, 0.3, f"light along the camera's {axis} axis, relative to all light")
        for axis in "xyz"
    )
    SOURCE: ClassVar[str] = (
        "Lambertian reflection under distant light: Basri and Jacobs, Lambertian Reflectance and Linear "
        "Subspaces, IEEE TPAMI 25(2), 2003 (the first four harmonics are a constant and the normal)"
    )

    def brightness(self, normals: Tensor, reference: Tensor) -> Tensor:
        """See BrightnessEffect."""
        return 1 + (normals - reference) @ self.values.to(normals.dtype)
