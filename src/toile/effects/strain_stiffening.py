"""Strain stiffening: crimped yarns straighten out, sheared yarns lock."""

from __future__ import annotations

import copy
from typing import ClassVar, Self

import torch
from torch import Tensor

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

    In a session (``in_detail``) a cloth may also stiffen and then stay as stiff: Y (1 + c ε² / (ε² + ε_k²))
    and S (1 + d φ² / (φ² + φ_k²)) beside, with knees ε_k and φ_k. Yarns that have straightened out do that,
    and what grows with the square all the way has next to nothing to say of it.
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
    KNEES: ClassVar[tuple[float, float]] = (0.003, 0.05)
    """Strain and angle [rad] at which half of what saturates is reached."""
    SATURATING: ClassVar[tuple[Parameter, ...]] = (
        Parameter(
            "stretching_beyond_knee", "1", 0.0, 30.0, 1.0, "c: grows by that share beyond a strain of ε_k"
        ),
        Parameter("shearing_beyond_knee", "1", 0.0, 30.0, 1.0, "d: the same beyond an angle of φ_k"),
    )
    SOURCE: ClassVar[str] = (
        "Volino, Magnenat-Thalmann and Faure, A Simple Approach to Nonlinear Tensile Stiffness for Accurate "
        "Cloth Simulation, ACM Transactions on Graphics 28(4), 2009"
    )

    _detailed = False

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """See Effect."""
        return (*self.PARAMETERS, *self.SATURATING) if self._detailed else self.PARAMETERS

    def in_detail(self) -> Self:
        """See Effect: with what saturates."""
        if self._detailed:
            return self
        other = copy.copy(self)
        other._detailed = True
        return other.with_values(torch.cat((self.values, self.values.new_zeros(len(self.SATURATING)))))

    def elements(self, elements: Elements, now: StepContext) -> Elements:
        """See ElementTerm."""
        if not self.is_active:
            return elements
        of = now.cloth.energies.named
        # A cloth that has grown is not strained by that.
        strain, angle = (of(n).strain(now.positions, elements.rest[n]) for n in ("stretching", "shearing"))
        before: Tensor | float = 0.0
        if elements.tensions is not None:
            stiffness = now.material["stretching"].detach()
            before = elements.tensions / (stiffness * elements.rest["stretching"])
        stretching, shearing = self.values[:2]
        stretch = 1 + stretching * (strain.square() + 3 * before * (before + strain))
        shear = 1 + shearing * angle.square()
        if self._detailed:
            (stretched, sheared), (knee, bent) = self.values[2:], self.KNEES
            stretch = stretch + stretched * _saturated(strain, knee, before)
            shear = shear + sheared * _saturated(angle, bent)
        return elements.scaled(stretching=stretch, shearing=shear)


def _saturated(further: Tensor, knee: float, before: Tensor | float = 0.0) -> Tensor:
    """Slope of the chord of e³ / (e² + knee²) from ``before`` to ``before + further``, which may meet."""
    square, after = knee**2, before + further
    return 1 - square * (square - before * after) / ((before**2 + square) * (after**2 + square))
