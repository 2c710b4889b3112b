"""Anisotropic stiffness: warp and weft yarns differ."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from toile.effects.base import ElementEffect, Parameter, Stage
from toile.errors import InputError
from toile.physics.cloth import Cloth
from toile.physics.elements import Elements
from toile.physics.step_terms import StepContext


class AnisotropicStiffness(ElementEffect):
    """Stiffness times exp(r / 2) along grid axis 0 and exp(-r / 2) along grid axis 1.

    The geometric mean of both directions stays what Y and B say.
    """

    NAME: ClassVar[str] = "anisotropic_stiffness"
    STAGE: ClassVar[Stage] = Stage.MECHANICS
    past_reach: ClassVar[int] = 0
    PARAMETERS: ClassVar[tuple[Parameter, ...]] = (
        Parameter("stretching", "1", -4.0, 4.0, 0.7, "natural logarithm of Y along axis 0 over axis 1"),
        Parameter("bending", "1", -4.0, 4.0, 0.7, "natural logarithm of B along axis 0 over axis 1"),
    )
    SOURCE: ClassVar[str] = (
        "Wang, O'Brien and Ramamoorthi, Data-Driven Elastic Models for Cloth: Modeling and Measurement, "
        "SIGGRAPH 2011 (warp and weft stiffness of ten fabrics)"
    )

    def elements(self, elements: Elements, now: StepContext) -> Elements:
        """See ElementTerm."""
        if not self.is_active:
            return elements
        stretching, bending = self.values / 2
        of = now.cloth.energies.named
        return elements.scaled(
            stretching=torch.exp(stretching * _sign(of("stretching").stencil, now.cloth)),
            bending=torch.exp(bending * _sign(of("bending").stencil, now.cloth)),
        )


def _sign(index: Tensor, cloth: Cloth) -> Tensor:
    """+1 for elements along grid axis 0, -1 along axis 1."""
    if cloth.grid is None:
        raise InputError(
            "warp and weft need a cloth on a grid", where="cloth", expected="a grid", got="a general mesh"
        )
    along_0 = index[:, 1] - index[:, 0] == cloth.grid[1]
    return 2 * along_0.to(torch.float64) - 1
