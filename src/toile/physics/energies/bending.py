"""Bending energy (paper, Eq. 9)."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor
from torch.nn.functional import normalize, pad

from toile.physics.energies.angle import angle_between, squared_angle
from toile.physics.energies.term import EnergyTerm, TermKernels
from toile.physics.parameter_vector import Parameter


def bending_energy(
    positions: Tensor,
    straights: Tensor,
    stiffness: Tensor | float,
    rest_angles: Tensor | None = None,
    towards: Tensor | None = None,
) -> Tensor:
    """Energy B Σ (½ (θ - θ₀)² - <m, v̂ - û>) of the angles between consecutive edges û, v̂ of one direction.

    Args:
        positions: (..., N, 3) [m].
        straights: (S, 3) vertex indices (i, k, j).
        stiffness: B [N·m], broadcastable to (..., S).
        rest_angles: θ₀ ≥ 0 (S,) [rad]; flat at rest if None. θ has no sign: θ₀ > 0 is a bend of that size
            to whichever side, and the energy has a kink at θ = 0, where the gradient of θ is taken as 0.
        towards: m (S, 3) [rad], a bend with a side; none if None. A moment of constant direction, smooth at
            θ = 0: where θ₀ = 0 and bends are small the energy is B Σ ½ |v̂ - û - m|² up to a constant.

    Returns:
        Energy [J], shape (...).
    """
    k = positions[..., straights[:, 1], :]
    before, after = k - positions[..., straights[:, 0], :], positions[..., straights[:, 2], :] - k
    away = squared_angle(before, after)
    if rest_angles is not None:
        # Expanded, so that the part of θ₀ = 0 stays as smooth as without rest angles.
        away = away - 2 * rest_angles * angle_between(before, after) + rest_angles.square()
    if towards is not None:
        away = away - 2 * (towards * (normalize(after, dim=-1) - normalize(before, dim=-1))).sum(-1)
    return 0.5 * (stiffness * away).sum(-1)


class Bending(EnergyTerm):
    """Bending of warp and weft: element (i, k, j), edges i->k and k->j.

    Its rest shape (E, 4) is the angle θ₀ ≥ 0 and the bend m towards which a moment of constant direction
    turns it, see bending_energy [rad]. Angles alone (E,) will do.
    """

    name: ClassVar[str] = "bending"
    parameters: ClassVar[tuple[Parameter, ...]] = (Parameter("bending", "B", "N·m"),)
    n_coefficients: ClassVar[int] = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.rest.ndim == 1:
            object.__setattr__(self, "rest", pad(self.rest[:, None], (0, 3)))

    def energy(self, positions: Tensor, coefficients: Tensor, factors: Tensor, rest: Tensor) -> Tensor:
        """See EnergyTerm."""
        return bending_energy(positions, self.stencil, coefficients * factors, rest[:, 0], rest[:, 1:])

    def measure(self, positions: Tensor) -> Tensor:
        """Angles (E,) [rad]."""
        before, middle, after = positions[self.stencil].unbind(1)
        return angle_between(middle - before, after - middle)

    def strain(self, positions: Tensor, rest: Tensor | None = None) -> Tensor:
        """See EnergyTerm."""
        return self.measure(positions) - (self.rest if rest is None else rest)[:, 0]

    def turns(self, positions: Tensor) -> Tensor:
        """v̂ - û (E, 3): where the next edge points beyond the one before; of length 2 sin(θ/2)."""
        before, middle, after = positions[self.stencil].unbind(1)
        return normalize(after - middle, dim=-1) - normalize(middle - before, dim=-1)

    def forces_by_rest(
        self, positions: Tensor, coefficients: Tensor, factors: Tensor, k: int
    ) -> Tensor | None:
        """See EnergyTerm: those by m are B ∂(v̂ - û)/∂x."""
        if k == 0:
            return None
        before, middle, after = positions.unbind(1)
        of_edges = []
        for edge in (middle - before, after - middle):
            length = edge.norm(dim=-1, keepdim=True)
            unit = edge / length
            across = -unit[:, k - 1 : k] * unit
            across[:, k - 1] += 1.0
            of_edges.append(coefficients * factors[:, None] * across / length)
        first, second = of_edges
        return torch.stack((first, -first - second, second), dim=1)

    def kernels(self) -> TermKernels:
        """See EnergyTerm."""
        from toile.physics.energies.angle_kernels import bending_derivatives, bending_energies

        return TermKernels(bending_energies, bending_derivatives)
