"""Internal damping: fibres and yarns that rub against each other while the cloth deforms."""

from __future__ import annotations

from functools import partial
from typing import ClassVar

import torch
from torch import Tensor

from toile.effects.base import ElementEffect, Parameter, Stage
from toile.physics.elements import Elements
from toile.physics.energies.bending import Bending
from toile.physics.step_terms import StepContext


class InternalDamping(ElementEffect):
    """Kelvin-Voigt: every element pulls with k (e - e₀ + τ ė), ė = (e_{n+1} - e_n) / h.

    e is an edge's length or a corner's angle. With r = τ / h this is the elastic force
    k (1 + r) (e_{n+1} - (e₀ + r e_n) / (1 + r)): a factor and a shifted rest shape, no new kind of element,
    and exactly no force on rigid motion.

    A straight's angle has no sign. Shifted in the same way, its potential would have as many lowest points as
    there are sides to bend to, and a step would end in either of two. So what the dashpot remembers is the
    bend with its side, v̂ - û of the edges before and after, turned as the straight itself will have turned by
    the end of the step if it goes on as it moves: B ((1 + r) θ²/2 - r <m, v̂ - û>), m of the size of the old
    bend along the new one. Its force vanishes where nothing moves, and on rigid motion but for what the
    prediction is wrong by, which is of second order in h.
    """

    NAME: ClassVar[str] = "internal_damping"
    STAGE: ClassVar[Stage] = Stage.MECHANICS
    own_past: ClassVar[bool] = True
    rank: ClassVar[int] = 2
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
        rest = {}
        for name in ("stretching", "shearing"):
            # Whatever the values are: derivatives by them ask for several in the same step.
            measured = now.cloth.energies.named(name).measure
            shape = now.once((InternalDamping, name), partial(measured, now.positions))
            rest[name] = _shifted(elements.rest[name], shape, in_plane)
        if now.cloth.energies.named("shearing").stencil.shape[1] == 2:
            # A diagonal counts by its strain, so by its rest length, which is still the one before.
            elements = elements.scaled(shearing=(rest["shearing"] / elements.rest["shearing"]).square())
        angles, towards = elements.rest["bending"].split([1, 3], dim=1)
        towards = towards + bending * now.once((InternalDamping, "bending"), partial(_remembered, now))
        # The factor below is on all of it; what rest angles and other moments do stays as it is.
        rest["bending"] = torch.cat((angles, towards), dim=1) / (1 + bending)
        return elements.scaled(**{n: 1 + ratio for n, ratio in ratios.items()}).with_rest(**rest)


def _shifted(rest: Tensor, now: Tensor, ratio: Tensor) -> Tensor:
    return (rest + ratio * now) / (1 + ratio)


def _remembered(now: StepContext) -> Tensor:
    """The bends at x_n, turned as the straights will be at the end of the step (S, 3) [rad].

    Where no straight turns, <m, v̂ - û> has there the slope of θ²/2.
    """
    straights = now.cloth.energies.named("bending")
    if not isinstance(straights, Bending):
        straights.measure(now.positions)  # says what it lacks
        raise TypeError(f"internal damping: expected straights of warp and weft, got {straights.name}")
    before = straights.turns(now.positions)
    after = straights.turns(now.positions + now.time_step * now.velocities)
    old, new = (turn.square().sum(-1, keepdim=True) for turn in (before, after))
    size, size_after = (old + _CHANCE**2).sqrt(), (new + _CHANCE**2).sqrt()
    # Of a bend that goes through flat within the step, the new one points the other way.
    alike = (2 * (before * after).sum(-1, keepdim=True) / (size * size_after)).clamp(-1.0, 1.0)
    turned = alike * (3 - alike.square()) / 2 * size / size_after * after
    # Where a straight is nearly flat nobody knows how it turns, and its moment is small.
    known = old * new / (old * new + _FLAT**4)
    half_sine = (size / 2).clamp(max=_FOLDED)
    slope = torch.asin(half_sine) / (half_sine * (1 - half_sine.square()).sqrt())
    return slope * (before + known * (turned - before))


_FLAT = 0.02
"""Bend up to which a straight counts as flat [rad]."""
_CHANCE = 0.1 * _FLAT
"""Bend below which its side is chance [rad]."""
_FOLDED = 0.95
"""Sine of half an angle beyond which a straight counts as folded."""
