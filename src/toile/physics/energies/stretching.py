"""Stretching energy (paper, Eq. 7)."""

from __future__ import annotations

from typing import ClassVar

from torch import Tensor

from toile.physics.energies.term import EnergyTerm, TermKernels
from toile.physics.parameter_vector import Parameter


def edge_lengths(positions: Tensor, edges: Tensor) -> Tensor:
    """Lengths (..., E) [m] of edges (E, 2) at positions (..., N, 3) [m]."""
    return (positions[..., edges[:, 1], :] - positions[..., edges[:, 0], :]).norm(dim=-1)


def stretching_energy(
    positions: Tensor, edges: Tensor, rest_lengths: Tensor, stiffness: Tensor | float
) -> Tensor:
    """Hookean energy ½ Y Σ (‖e‖ - L₀)² of every edge.

    Args:
        positions: (..., N, 3) [m].
        edges: (E, 2) vertex indices.
        rest_lengths: (E,) or scalar L₀ [m].
        stiffness: Y [N/m], broadcastable to (..., E).

    Returns:
        Energy [J], shape (...).
    """
    return 0.5 * (stiffness * (edge_lengths(positions, edges) - rest_lengths) ** 2).sum(-1)


class Stretching(EnergyTerm):
    """Stretching of warp and weft: element (k, l) of rest length L₀ [m]."""

    name: ClassVar[str] = "stretching"
    parameters: ClassVar[tuple[Parameter, ...]] = (Parameter("stretching", "Y", "N/m"),)
    n_coefficients: ClassVar[int] = 1

    def energy(self, positions: Tensor, coefficients: Tensor, factors: Tensor, rest: Tensor) -> Tensor:
        """See EnergyTerm."""
        return stretching_energy(positions, self.stencil, rest, coefficients * factors)

    def measure(self, positions: Tensor) -> Tensor:
        """Lengths (E,) [m]."""
        return edge_lengths(positions, self.stencil)

    def strain(self, positions: Tensor, rest: Tensor | None = None) -> Tensor:
        """See EnergyTerm: ‖e‖ / L₀ - 1."""
        return self.measure(positions) / (self.rest if rest is None else rest) - 1

    def kernels(self) -> TermKernels:
        """See EnergyTerm."""
        from toile.physics.energies.stretching_kernels import stretching_derivatives, stretching_energies

        return TermKernels(stretching_energies, stretching_derivatives)
