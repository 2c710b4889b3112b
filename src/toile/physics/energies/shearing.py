"""Shearing energy (paper, Eq. 8)."""

from __future__ import annotations

from typing import ClassVar

from torch import Tensor

from toile.physics.energies.angle import angle_between
from toile.physics.energies.term import EnergyTerm, TermKernels
from toile.physics.parameter_vector import Parameter


def shearing_energy(
    positions: Tensor, corners: Tensor, rest_angles: Tensor | float, stiffness: Tensor | float
) -> Tensor:
    """Energy ½ S Σ (φ - φ₀)² of the angles enclosed by a warp and a weft edge.

    Args:
        positions: (..., N, 3) [m].
        corners: (C, 3) vertex indices (i, k, j), the angle is at k.
        rest_angles: (C,) or scalar φ₀ [rad]; π/2 for a planar fabric.
        stiffness: S [N·m], broadcastable to (..., C).

    Returns:
        Energy [J], shape (...).
    """
    k = positions[..., corners[:, 1], :]
    angle = angle_between(positions[..., corners[:, 0], :] - k, positions[..., corners[:, 2], :] - k)
    return 0.5 * (stiffness * (angle - rest_angles) ** 2).sum(-1)


class Shearing(EnergyTerm):
    """Shearing between warp and weft: element (i, k, j) of rest angle φ₀ [rad] at k."""

    name: ClassVar[str] = "shearing"
    parameters: ClassVar[tuple[Parameter, ...]] = (Parameter("shearing", "S", "N·m"),)
    n_coefficients: ClassVar[int] = 1

    def energy(self, positions: Tensor, coefficients: Tensor, factors: Tensor, rest: Tensor) -> Tensor:
        """See EnergyTerm."""
        return shearing_energy(positions, self.stencil, rest, coefficients * factors)

    def measure(self, positions: Tensor) -> Tensor:
        """Angles (E,) [rad]."""
        i, k, j = positions[self.stencil].unbind(1)
        return angle_between(i - k, j - k)

    def kernels(self) -> TermKernels:
        """See EnergyTerm."""
        from toile.physics.energies.angle_kernels import shearing_derivatives, shearing_energies

        return TermKernels(shearing_energies, shearing_derivatives)
