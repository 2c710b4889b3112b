"""Springs that resist compression less than tension: edges and diagonals of a grid.

Cloth wrinkles below a grid of one or two centimetres. What a grid sees of its resistance to compression is
then the buckling of the sheet and not the thread: tension-field theory (Reissner, On tension field theory,
1938; Pipkin, The relaxed energy density for isotropic elastic membranes, 1986), and in graphics Choi and Ko,
Stable but Responsive Cloth, 2002. A ratio of 1 is the thread's own, of 0 a thread that only pulls.
"""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from toile.physics.energies.stretching import edge_lengths
from toile.physics.energies.term import EnergyTerm, TermKernels
from toile.physics.parameter_vector import Parameter


def spring_energies(positions: Tensor, ends: Tensor, rest_lengths: Tensor) -> tuple[Tensor, Tensor]:
    """½ (‖e‖ - L₀)² where an edge is longer than at rest, and where it is shorter; 0 elsewhere.

    Args:
        positions: (..., N, 3) [m].
        ends: (E, 2) vertex indices.
        rest_lengths: L₀ (E,) [m].

    Returns:
        Both, (..., E) [m²].
    """
    stretch = edge_lengths(positions, ends) - rest_lengths
    return 0.5 * stretch.clamp(min=0.0) ** 2, 0.5 * stretch.clamp(max=0.0) ** 2


def _with_compression(values: Tensor) -> Tensor:
    """Stiffnesses (..., 2) in tension and in compression from (..., 2) that in tension and the ratio.

    A ratio beyond 1 counts as 1: not every Gauss-Newton in logarithms knows bounds.
    """
    stiffness, ratio = values.unbind(-1)
    return torch.stack((stiffness, stiffness * ratio.clamp(max=1.0)), -1)


class TautStretching(EnergyTerm):
    """Stretching of warp and weft with a compression ratio: element (k, l) of rest length L₀ [m]."""

    name: ClassVar[str] = "stretching"
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("stretching", "Y", "N/m"),
        Parameter("edge_compression", "c_Y", "", 0.0, 1.0),
    )
    n_coefficients: ClassVar[int] = 2

    def coefficients(self, values: Tensor) -> Tensor:
        """See EnergyTerm: Y in tension, c_Y Y in compression [N/m]."""
        return _with_compression(values)

    def energy(self, positions: Tensor, coefficients: Tensor, factors: Tensor, rest: Tensor) -> Tensor:
        """See EnergyTerm."""
        longer, shorter = spring_energies(positions, self.stencil, rest)
        return (factors * (coefficients[..., :1] * longer + coefficients[..., 1:] * shorter)).sum(-1)

    def measure(self, positions: Tensor) -> Tensor:
        """Lengths (E,) [m]."""
        return edge_lengths(positions, self.stencil)

    def strain(self, positions: Tensor, rest: Tensor | None = None) -> Tensor:
        """See EnergyTerm: ‖e‖ / L₀ - 1."""
        return self.measure(positions) / (self.rest if rest is None else rest) - 1

    def kernels(self) -> TermKernels:
        """See EnergyTerm."""
        from toile.physics.energies.spring_kernels import edge_derivatives, edge_energies

        return TermKernels(edge_energies, edge_derivatives)


class DiagonalShearing(EnergyTerm):
    """Shearing resisted by the diagonals of the cells: element (k, l) of rest length d₀ [m].

    The energy is S/2 (2 ε)² per diagonal with the strain ε = ‖d‖ / d₀ - 1: at small shear angles γ a diagonal
    changes by ε = ± γ / 2, and both together cost S γ², half of what the four corners of a cell cost in Eq. 8
    where compression counts in full. Diagonals that only pull leave half of that again.
    """

    name: ClassVar[str] = "shearing"
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("shearing", "S", "N·m"),
        Parameter("diagonal_compression", "c_S", "", 0.0, 1.0),
    )
    n_coefficients: ClassVar[int] = 2

    def coefficients(self, values: Tensor) -> Tensor:
        """See EnergyTerm: S in tension, c_S S in compression [N·m]."""
        return _with_compression(values)

    def energy(self, positions: Tensor, coefficients: Tensor, factors: Tensor, rest: Tensor) -> Tensor:
        """See EnergyTerm."""
        longer, shorter = spring_energies(positions, self.stencil, rest)
        weight = factors * 4.0 / rest.square()
        return (weight * (coefficients[..., :1] * longer + coefficients[..., 1:] * shorter)).sum(-1)

    def measure(self, positions: Tensor) -> Tensor:
        """Lengths (E,) [m]."""
        return edge_lengths(positions, self.stencil)

    def strain(self, positions: Tensor, rest: Tensor | None = None) -> Tensor:
        """The shear angle γ = 2 ε that changes a diagonal that much [rad]."""
        return 2 * (self.measure(positions) / (self.rest if rest is None else rest) - 1)

    def kernels(self) -> TermKernels:
        """See EnergyTerm."""
        from toile.physics.energies.spring_kernels import diagonal_derivatives, diagonal_energies

        return TermKernels(diagonal_energies, diagonal_derivatives)
