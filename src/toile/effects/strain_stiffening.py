"""Strain stiffening: crimped yarns straighten out, sheared yarns lock."""

from __future__ import annotations

from typing import ClassVar

from toile.effects.base import ElementEffect, Parameter, Stage
from toile.physics.elements import Elements
from toile.physics.step_terms import StepContext


class StrainStiffening(ElementEffect):
    """Secant stiffness Y (1 + a ε²) with the strain ε = ‖e‖ / L₀ - 1, and S (1 + b (φ - φ₀)²).

    The strain is that at the step's begin, from the rest shape of the step. The tension is then
    Y L₀ (ε + a ε³), the first odd term of a measured curve, which stiffens in tension and compression alike.

    Where the rest shape is under a tension T already, strain counts from the unstretched length, which T
    implies to first order: ε₀ = T / (Y L₀). T itself is the load's and stays, so the stiffness is that of the
    curve's chord from ε₀ to ε₀ + ε: Y (1 + a (3 ε₀² + 3 ε₀ ε + ε²)), that of a tangent where ε is 0.
    """

    NAME: ClassVar[str] = "strain_stiffening"
    STAGE: ClassVar[Stage] = Stage.MECHANICS
    past_reach: ClassVar[int] = 1
    own_past: ClassVar[bool] = True
    rank: ClassVar[int] = 1
    PARAMETERS: ClassVar[tuple[Parameter, ...]] = (
        Parameter("stretching", "1", 0.0, 1e5, 500.0, "a: the stiffness doubles at a strain of 1 / √a"),
        Parameter("shearing", "1/rad²", 0.0, 1e3, 10.0, "b: the stiffness doubles at an angle of 1 / √b"),
    )
    SOURCE: ClassVar[str] = (
        "Volino, Magnenat-Thalmann and Faure, A Simple Approach to Nonlinear Tensile Stiffness for Accurate "
        "Cloth Simulation, ACM Transactions on Graphics 28(4), 2009"
    )

    def elements(self, elements: Elements, now: StepContext) -> Elements:
        """See ElementTerm."""
        if not self.is_active:
            return elements
        stretching, shearing = self.values
        of = now.cloth.energies.named
        # A cloth that has grown is not strained by that.
        strain, angle = (of(n).strain(now.positions, elements.rest[n]) for n in ("stretching", "shearing"))
        growth = strain.square()
        if elements.tensions is not None:
            stiffness = now.material["stretching"].detach()
            before = elements.tensions / (stiffness * elements.rest["stretching"])
            growth = growth + 3 * before * (before + strain)
        return elements.scaled(stretching=(1 + stretching * growth), shearing=(1 + shearing * angle.square()))
