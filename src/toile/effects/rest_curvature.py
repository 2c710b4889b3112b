"""Rest curvature: cloth that wants to roll up (woven tension, ironing, storage on a roll)."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor
from torch.nn.functional import normalize

from toile.effects.base import Parameter, Stage, VertexEffect
from toile.errors import InputError
from toile.physics.cloth import Cloth
from toile.physics.step_terms import StepContext


class RestCurvature(VertexEffect):
    """Bending energy ½ B Σ (θ - κ L)² instead of ½ B Σ θ², θ signed by the cloth's normal.

    What is new is -B κ L Σ θ, a constant bending moment B κ L in every straight. Its force, B κ L ∂θ/∂x, is
    taken where the step begins, so the potential is linear in the new positions; at rest it balances the
    elastic bending force exactly where θ = κ L. It adds no momentum, and no angular momentum
    where the cloth does not bend within its own plane.

    θ > 0 where the cloth curves towards its normal (StepContext.normals), κ = 1 / radius then.
    """

    NAME: ClassVar[str] = "rest_curvature"
    STAGE: ClassVar[Stage] = Stage.MECHANICS
    PARAMETERS: ClassVar[tuple[Parameter, ...]] = (
        Parameter("axis_0", "1/m", -50.0, 50.0, 5.0, "natural curvature along grid axis 0"),
        Parameter("axis_1", "1/m", -50.0, 50.0, 5.0, "natural curvature along grid axis 1"),
    )
    SOURCE: ClassVar[str] = (
        "Grinspun, Hirani, Desbrun and Schröder, Discrete Shells, SCA 2003 (bending about a "
        "curved rest shape)"
    )

    def energy(self, positions: Tensor, now: StepContext) -> Tensor:
        """See VertexTerm."""
        forces = now.once(self, lambda: self._forces(now))
        return -(forces * positions).sum(-1)

    def _forces(self, now: StepContext) -> Tensor:
        """B κ L Σ ∂θ/∂x (N, 3) [N] where the step begins."""
        return now.material["bending"] * _angle_gradients(now, _curvatures(self.values, now.cloth))


def _curvatures(values: Tensor, cloth: Cloth) -> Tensor:
    """κ L of every straight (S,) [rad], L the length that belongs to its middle vertex."""
    if cloth.grid is None:
        raise InputError(
            "rest curvature needs a cloth on a grid", where="cloth", expected="a grid", got="a general mesh"
        )
    h, w = cloth.grid
    along_0 = cloth.rest_lengths[: (h - 1) * w].reshape(h - 1, w)
    along_1 = cloth.rest_lengths[(h - 1) * w :].reshape(h, w - 1)
    lengths_0 = (along_0[:-1] + along_0[1:]).reshape(-1) / 2
    lengths_1 = (along_1[:, :-1] + along_1[:, 1:]).reshape(-1) / 2
    return torch.cat((values[0] * lengths_0, values[1] * lengths_1))


def _angle_gradients(now: StepContext, weights: Tensor) -> Tensor:
    """Σ weight ∂θ/∂x over the straights, (N, 3) [1/m], at x_n.

    With the unit edges u and v before and after the vertex and n the normal within their bisecting plane,
    2 sin(θ/2) = <v - u, n>. Turning n does not change it to first order where v - u is along n.
    """
    index = now.cloth.energies.named("bending").stencil
    before, middle, after = now.positions[index].unbind(1)
    u, v = middle - before, after - middle
    u_length, v_length = u.norm(dim=-1, keepdim=True), v.norm(dim=-1, keepdim=True)
    u, v = u / u_length, v / v_length
    tangent = normalize(u + v, dim=-1)
    n = now.normals[index[:, 1]]
    n = normalize(n - (n * tangent).sum(-1, keepdim=True) * tangent, dim=-1)
    half_sine = ((v - u) * n).sum(-1, keepdim=True) / 2
    # A complete fold has no bisecting plane.
    slope = weights[:, None] / (1 - half_sine.square()).clamp(min=1e-4).sqrt()
    to_after = slope * (n - (n * v).sum(-1, keepdim=True) * v) / v_length
    to_before = slope * (n - (n * u).sum(-1, keepdim=True) * u) / u_length
    total = torch.zeros_like(now.positions)
    total = total.index_add(0, index[:, 2], to_after).index_add(0, index[:, 0], to_before)
    return total.index_add(0, index[:, 1], -to_after - to_before)
