"""Non-uniform stiffness: seams, prints, worn places."""

from __future__ import annotations

from typing import ClassVar

import torch

from toile.effects.base import ElementEffect, Parameter, Stage
from toile.effects.modes import SmoothField, mode_parameters
from toile.physics.elements import Elements
from toile.physics.step_terms import StepContext


class NonuniformStiffness(SmoothField, ElementEffect):
    """All three stiffnesses times exp(Σ a_m c_m) with smooth cosine modes c_m, at every element's centre."""

    NAME: ClassVar[str] = "nonuniform_stiffness"
    STAGE: ClassVar[Stage] = Stage.MECHANICS
    past_reach: ClassVar[int] = 0
    ALONG_EACH: ClassVar[tuple[float, float, float, str]] = (-3.0, 3.0, 0.5, "logarithm of stiffness")
    ENDS: ClassVar[tuple[str, str]] = ("softest places", "stiffest places")
    PARAMETERS: ClassVar[tuple[Parameter, ...]] = mode_parameters(*ALONG_EACH)
    SOURCE: ClassVar[str] = (
        "Ghanem and Spanos, Stochastic Finite Elements: A Spectral Approach, 1991 (expansion of material "
        "fields in few smooth functions; here the Laplacian's eigenmodes with free borders)"
    )

    def elements(self, elements: Elements, now: StepContext) -> Elements:
        """See ElementTerm."""
        if not self.is_active:
            return elements
        logarithm = self.field(now.cloth)
        return elements.scaled(
            **{term.name: torch.exp(logarithm[term.stencil].mean(-1)) for term in now.cloth.energies}
        )
