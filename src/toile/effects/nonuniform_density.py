"""Non-uniform density: hems, prints and wet spots."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from toile.effects.base import MassEffect, Parameter, Stage, Surroundings
from toile.effects.modes import SmoothField, mode_parameters


class NonuniformDensity(SmoothField, MassEffect):
    """Density times exp(Σ a_m c_m) with smooth cosine modes c_m of zero mean.

    The total mass stays what it is to first order in a_m.
    """

    NAME: ClassVar[str] = "nonuniform_density"
    STAGE: ClassVar[Stage] = Stage.MECHANICS
    ALONG_EACH: ClassVar[tuple[float, float, float, str]] = (-1.5, 1.5, 0.3, "logarithm of the density")
    ENDS: ClassVar[tuple[str, str]] = ("lightest places", "heaviest places")
    PARAMETERS: ClassVar[tuple[Parameter, ...]] = mode_parameters(*ALONG_EACH)
    SOURCE: ClassVar[str] = (
        "Ghanem and Spanos, Stochastic Finite Elements: A Spectral Approach, 1991 (expansion of material "
        "fields in few smooth functions; here the Laplacian's eigenmodes with free borders)"
    )

    def masses(self, masses: Tensor, around: Surroundings) -> Tensor:
        """See MassEffect."""
        if not self.is_active:
            return masses
        return masses * torch.exp(self.field(around.cloth))
