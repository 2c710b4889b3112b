"""Rest curvature: cloth that wants to roll up or to fold (woven tension, ironing, storage, creases)."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from functools import lru_cache, partial
from typing import ClassVar, Self

import torch
from torch import Tensor
from torch.nn.functional import normalize

from toile.effects.base import Amount, Parameter, Stage, Surroundings, VertexEffect
from toile.errors import InputError
from toile.limits import CountOrZero
from toile.physics.cloth import Cloth
from toile.physics.step_terms import StencilForces, StepContext

_SCALE = 1e-3
"""Of the moments [N]: a curvature of 5 / m in a cloth of usual stiffness, 2e-4 N·m."""
_USUAL = 5.0
"""Of natural curvatures [1/m], whatever the stiffness."""
_TIGHTEST = 200.0
"""Natural curvature that no cloth exceeds [1/m]: a roll of 1 cm across."""

IN_DETAIL = 4
"""Half waves that resolve a quarter of the cloth: a fold."""


@lru_cache
def _parameters(half_waves: int) -> tuple[Parameter, ...]:
    means = (
        Parameter(f"axis_{a}", "N", -0.1, 0.1, _SCALE, f"B κ, moment per width, along grid axis {a}")
        for a in (0, 1)
    )
    varying = (
        Parameter(
            f"axis_{a}_{p}", "N", -0.1, 0.1, _SCALE, f"its variation along grid axis {a}, {p} half waves"
        )
        for a in (0, 1)
        for p in range(1, half_waves + 1)
    )
    return (*means, *varying)


class RestCurvature(VertexEffect):
    """Bending energy ½ B Σ (θ - κ L)² instead of ½ B Σ θ², θ signed by the cloth's normal.

    What is new is -M L Σ θ, a constant bending moment M = B κ per width in every straight. Its force,
    M L ∂θ/∂x, is taken where the step begins, so the potential is linear in the new positions; at rest it
    balances the elastic bending force exactly where θ = κ L. It adds no momentum, and no angular momentum
    where the cloth does not bend within its own plane.

    Parameters are of M: it moves the cloth whatever B is, while of B and κ the motion shows the product
    first, and a fit of both goes along a curved valley. What is known beforehand is of κ, see ``deviation``.

    θ > 0 where the cloth curves towards its normal (StepContext.normals), κ = M / B = 1 / radius then.

    M along an axis may vary along it, M(u) = M + Σ_p M_p cos(pπu), u from 0 to 1: what was on a roll is
    curved everywhere, a fold or a rolled edge in a band.

    Args:
        values: see Effect.
        half_waves: of the shortest mode of M along its axis; None for 0, or as many as ``in_detail`` takes.

    Raises:
        InputError: there are no such modes, or values of others.
    """

    NAME: ClassVar[str] = "rest_curvature"
    STAGE: ClassVar[Stage] = Stage.MECHANICS
    quadratic: ClassVar[bool] = True
    PARAMETERS: ClassVar[tuple[Parameter, ...]] = _parameters(0)
    STIFFNESS: ClassVar[str] = "bending"
    SOURCE: ClassVar[str] = (
        "Grinspun, Hirani, Desbrun and Schröder, Discrete Shells, SCA 2003 (bending about a "
        "curved rest shape)"
    )

    def __init__(
        self, values: Mapping[str, float] | None = None, half_waves: CountOrZero | None = None
    ) -> None:
        if half_waves is not None and half_waves < 0:
            raise InputError(
                "rest curvature: no such modes",
                where="effect=rest_curvature",
                expected="half_waves >= 0",
                got=str(half_waves),
            )
        self._given = half_waves is not None
        self.half_waves = half_waves or 0
        super().__init__(values)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """See Effect."""
        return _parameters(self.half_waves)

    def in_detail(self) -> Self:
        """See Effect: four half waves where no number of them was given."""
        if self._given or self.half_waves:
            return self
        other = copy.copy(self)
        other.half_waves = IN_DETAIL
        return other.with_values(torch.cat((self.values, self.values.new_zeros(2 * IN_DETAIL))))

    def deviation(self, material: Mapping[str, float]) -> float:
        """See Effect: natural curvatures of 5 / m, whatever B is."""
        return _USUAL * material["bending"] / _SCALE

    def is_possible(self, material: Mapping[str, float]) -> bool:
        """See Effect: a natural curvature acts through B, and rolled edges of knitwear are the tightest."""
        places = torch.linspace(0, 1, 4 * self.half_waves + 3, dtype=torch.float64)[1:-1]
        moments = torch.cat(_along(self.values, places, places))
        return bool(moments.abs().max() <= _TIGHTEST * material["bending"])

    def acts_on(self, around: Surroundings, motion: Tensor) -> Tensor | None:
        """See Effect: the size of both moments; None where they are the same everywhere."""
        if not self.half_waves:
            return None
        of_rows, of_columns = _along(self.values, *around.cloth.lines.places())
        return torch.hypot(of_rows[:, None], of_columns[None]).reshape(-1)

    def amounts(
        self, around: Surroundings, material: Mapping[str, float], times: Tensor
    ) -> tuple[Amount, ...]:
        """See Effect: κ where it is largest."""
        moments = torch.cat(_along(self.values, *around.cloth.lines.places()))
        tightest = float(moments.abs().max()) / material["bending"]
        return (Amount("tightest natural curvature", tightest, "1/m"),)

    def energy(self, positions: Tensor, now: StepContext) -> Tensor:
        """See VertexTerm."""
        forces = now.once(self, lambda: self._forces(now))
        return -(forces * positions).sum(-1)

    def stencil_forces(self, cloth: Cloth) -> StencilForces:
        """See VertexTerm: M L ∂θ/∂x of every straight."""
        stencil = cloth.energies.named("bending").stencil
        return StencilForces(stencil, 1, partial(_angle_gradients, _moments(self.values, cloth)))

    def force_derivatives(self, positions: Tensor, now: StepContext) -> Tensor:
        """See VertexEffect: moments are linear in the values."""
        one_by_one = torch.eye(len(self.values), dtype=torch.float64)
        return _summed(now, torch.stack([_moments(values, now.cloth) for values in one_by_one]))

    def _forces(self, now: StepContext) -> Tensor:
        """M L Σ ∂θ/∂x (N, 3) [N] where the step begins."""
        return _summed(now, _moments(self.values, now.cloth)[None])[0]


def _summed(now: StepContext, weights: Tensor) -> Tensor:
    """Σ weight ∂θ/∂x over the straights where the step begins (P, N, 3) [1/m], for weights (P, S)."""
    index = now.cloth.energies.named("bending").stencil
    unit = _angle_gradients(torch.ones_like(weights[0]), now.positions[index], now.normals[index[:, 1]])
    forces = (weights[:, :, None, None] * unit).flatten(1, 2)
    total = now.positions.new_zeros(len(weights), *now.positions.shape)
    return total.index_add(1, index.flatten(), forces)


def _moments(values: Tensor, cloth: Cloth) -> Tensor:
    """M L of every straight (S,) [N·m], L the length that belongs to its middle vertex."""
    if cloth.grid is None:
        raise InputError(
            "rest curvature needs a cloth on a grid", where="cloth", expected="a grid", got="a general mesh"
        )
    h, w = cloth.grid
    edges_0 = cloth.rest_lengths[: (h - 1) * w].reshape(h - 1, w)
    edges_1 = cloth.rest_lengths[(h - 1) * w :].reshape(h, w - 1)
    lengths_0 = (edges_0[:-1] + edges_0[1:]).reshape(-1) / 2
    lengths_1 = (edges_1[:, :-1] + edges_1[:, 1:]).reshape(-1) / 2
    inner = (places[1:-1] for places in cloth.lines.places())
    along_0, along_1 = _along(values, *inner)
    moments = torch.cat((along_0.repeat_interleave(w) * lengths_0, along_1.repeat(h) * lengths_1))
    # B of a straight on an uneven grid is that much of the even one's.
    return moments * cloth.energies.elements().factors["bending"]


def _along(values: Tensor, places_0: Tensor, places_1: Tensor) -> tuple[Tensor, Tensor]:
    """Moments M per width [N] along each axis, at places (n,) from 0 to 1 along it."""
    varying = values[2:].reshape(2, -1)
    waves = torch.pi * torch.arange(1, varying.shape[1] + 1, dtype=torch.float64)[:, None]
    along_0, along_1 = (
        mean + own @ torch.cos(waves * places)
        for mean, own, places in zip(values[:2], varying, (places_0, places_1), strict=True)
    )
    return along_0, along_1


def _angle_gradients(weights: Tensor, straights: Tensor, normals: Tensor) -> Tensor:
    """Weight ∂θ/∂x on the vertices of straights (..., S, 3, 3) [1/m].

    With the unit edges u and v before and after the vertex and n the normal within their bisecting plane,
    2 sin(θ/2) = <v - u, n>. Turning n does not change it to first order where v - u is along n.

    Args:
        weights: (S,).
        straights: positions of their vertices (..., S, 3, 3) [m].
        normals: of the middle ones (..., S, 3).
    """
    before, middle, after = straights.unbind(-2)
    u, v = middle - before, after - middle
    u_length, v_length = u.norm(dim=-1, keepdim=True), v.norm(dim=-1, keepdim=True)
    u, v = u / u_length, v / v_length
    tangent = normalize(u + v, dim=-1)
    n = normalize(normals - (normals * tangent).sum(-1, keepdim=True) * tangent, dim=-1)
    half_sine = ((v - u) * n).sum(-1, keepdim=True) / 2
    # A complete fold has no bisecting plane.
    slope = weights[:, None] / (1 - half_sine.square()).clamp(min=1e-4).sqrt()
    to_after = slope * (n - (n * v).sum(-1, keepdim=True) * v) / v_length
    to_before = slope * (n - (n * u).sum(-1, keepdim=True) * u) / u_length
    return torch.stack((to_before, -to_after - to_before, to_after), dim=-2)
