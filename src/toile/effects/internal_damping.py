"""Internal damping: fibres and yarns that rub against each other while the cloth deforms."""

from __future__ import annotations

from typing import ClassVar

from torch import Tensor

from toile.effects.base import ElementEffect, Parameter, Stage
from toile.physics.elements import Elements
from toile.physics.step_terms import StepContext


class InternalDamping(ElementEffect):
    """Kelvin-Voigt: every element pulls with k (e - e₀ + τ ė), ė = (e_{n+1} - e_n) / h.

    e is an edge's length, a corner's or a straight's angle. With r = τ / h this is the elastic force
    k (1 + r) (e_{n+1} - (e₀ + r e_n) / (1 + r)): a factor and a shifted rest shape, no new kind of element,
    and exactly no force on rigid motion. A straight's angle has no sign, so a bend that passes through flat
    within one step is damped as if it had turned back.
    """

    NAME: ClassVar[str] = "internal_damping"
    STAGE: ClassVar[Stage] = Stage.MECHANICS
    own_past: ClassVar[bool] = True
    PARAMETERS: ClassVar[tuple[Parameter, ...]] = (
        Parameter("in_plane", "s", 0.0, 1.0, 0.02, "relaxation time of stretch and shear"),
        Parameter("bending", "s", 0.0, 1.0, 0.05, "relaxation time of bending"),
    )
    SOURCE: ClassVar[str] = (
        "Baraff and Witkin, Large Steps in Cloth Simulation, SIGGRAPH 1998 (damping along each mode of "
        "deformation); Kelvin-Voigt solid: Findley, Lai and Onaran, Creep and Relaxation of Nonlinear "
        "Viscoelastic Materials, 1976"
    )

    def elements(self, elements: Elements, now: StepContext) -> Elements:
        """See ElementTerm."""
        if not self.is_active:
            return elements
        in_plane, bending = self.values / now.time_step
        ratios = {"stretching": in_plane, "shearing": in_plane, "bending": bending}
        shapes = {}
        for name, ratio in ratios.items():
            shape = now.cloth.energies.named(name).measure(now.positions)
            if name == "bending":
                shape = shape * _is_bent(shape)
            shapes[name] = _shifted(elements.rest[name], shape, ratio)
        return elements.scaled(**{n: 1 + ratio for n, ratio in ratios.items()}).with_rest(**shapes)


def _shifted(rest: Tensor, now: Tensor, ratio: Tensor) -> Tensor:
    return (rest + ratio * now) / (1 + ratio)


def _is_bent(bend: Tensor) -> Tensor:
    """0 up to _FLAT, 1 from twice that on, smooth in between: the side of a smaller bend is chance."""
    s = (bend / _FLAT - 1).clamp(0.0, 1.0)
    return s.square() * (3 - 2 * s)


_FLAT = 1e-3
"""[rad]"""
