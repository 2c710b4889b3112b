"""Mask bias: masks that are too wide or too narrow."""

from __future__ import annotations

from typing import ClassVar

from torch import Tensor

from toile.effects.base import MaskEffect, Parameter, Scope, Stage


class MaskBias(MaskEffect):
    """The mask's edge lies a constant distance outside of the cloth's."""

    NAME: ClassVar[str] = "mask_bias"
    STAGE: ClassVar[Stage] = Stage.OBSERVATION
    SCOPE: ClassVar[Scope] = Scope.DEVICE
    PARAMETERS: ClassVar[tuple[Parameter, ...]] = (
        Parameter("growth", "px", -10.0, 10.0, 1.0, "distance by which the mask reaches beyond the cloth"),
    )
    SOURCE: ClassVar[str] = (
        "offset of a region by a distance: Serra, Image Analysis and Mathematical Morphology, 1982 (dilation)"
    )

    def growth(self) -> Tensor:
        """See MaskEffect."""
        return self.values[0]
