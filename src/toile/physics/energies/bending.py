"""Bending energy (paper, Eq. 9)."""

from __future__ import annotations

from typing import ClassVar

from torch import Tensor

from toile.physics.energies.angle import angle_between, squared_angle
from toile.physics.energies.term import EnergyTerm, TermKernels
from toile.physics.parameter_vector import Parameter


def bending_energy(
    positions: Tensor, straights: Tensor, stiffness: Tensor | float, rest_angles: Tensor | None = None
) -> Tensor:
    """Energy ½ B Σ (θ - θ₀)² of the angles between consecutive edges of the same direction.

    Args:
        positions: (..., N, 3) [m].
        straights: (S, 3) vertex indices (i, k, j).
        stiffness: B [N·m], broadcastable to (..., S).
        rest_angles: θ₀ ≥ 0 (S,) [rad]; flat at rest if None. θ has no sign: θ₀ > 0 is a bend of that size
            to whichever side, and the energy has a kink at θ = 0, where the gradient of θ is taken as 0.

    Returns:
        Energy [J], shape (...).
    """
    k = positions[..., straights[:, 1], :]
    before, after = k - positions[..., straights[:, 0], :], positions[..., straights[:, 2], :] - k
    away = squared_angle(before, after)
    if rest_angles is not None:
        # Expanded, so that the part of θ₀ = 0 stays as smooth as without rest angles.
        away = away - 2 * rest_angles * angle_between(before, after) + rest_angles.square()
    return 0.5 * (stiffness * away).sum(-1)


class Bending(EnergyTerm):
    """Bending of warp and weft: element (i, k, j), edges i->k and k->j, of rest angle θ₀ ≥ 0 [rad]."""

    name: ClassVar[str] = "bending"
    parameters: ClassVar[tuple[Parameter, ...]] = (Parameter("bending", "B", "N·m"),)
    n_coefficients: ClassVar[int] = 1

    def energy(self, positions: Tensor, coefficients: Tensor, factors: Tensor, rest: Tensor) -> Tensor:
        """See EnergyTerm."""
        return bending_energy(positions, self.stencil, coefficients * factors, rest)

    def measure(self, positions: Tensor) -> Tensor:
        """Angles (E,) [rad]."""
        before, middle, after = positions[self.stencil].unbind(1)
        return angle_between(middle - before, after - middle)

    def kernels(self) -> TermKernels:
        """See EnergyTerm."""
        from toile.physics.energies.angle_kernels import bending_derivatives, bending_energies

        return TermKernels(bending_energies, bending_derivatives)
