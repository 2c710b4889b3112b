"""Bending of a triangle mesh at its inner edges: discrete shells.

Grinspun, Hirani, Desbrun and Schröder, Discrete Shells, 2003; derivatives as in Tamstorf and Grinspun,
Discrete bending forces and their Jacobians, 2013.
"""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from toile.physics.energies.term import EnergyTerm, TermKernels
from toile.physics.parameter_vector import Parameter


def dihedral_angles(positions: Tensor, hinges: Tensor) -> Tensor:
    """Signed angle [rad] between the normals of the two faces of every hinge, (..., I); 0 is flat.

    Positive where the faces fold away from their normals' side, like a ridge seen from there.

    Args:
        positions: (..., N, 3) [m].
        hinges: (I, 4): faces (0, 1, 2) and (1, 0, 3).
    """
    a, b, c, d = positions[..., hinges, :].unbind(-2)
    edge = b - a
    first = torch.linalg.cross(edge, c - a)
    second = torch.linalg.cross(d - a, edge)
    # Normals are of any length: the quotient of sine and cosine does not see it.
    sine = (torch.linalg.cross(first, second) * edge).sum(-1) / edge.norm(dim=-1)
    return torch.atan2(sine, (first * second).sum(-1))


def rest_hinges(positions: Tensor, hinges: Tensor, *, flat: bool) -> Tensor:
    """Rest shapes of hinges, (I, 2): angle at rest [rad], and ‖e‖² / (A₁ + A₂), edge length and face areas.

    Args:
        positions: at rest (N, 3) [m].
        hinges: (I, 4).
        flat: take the angles as 0, whatever the positions say.
    """
    p = positions.to(torch.float64)
    a, b, c, d = p[hinges].unbind(1)
    edge = b - a
    areas = sum(0.5 * torch.linalg.cross(edge, other - a).norm(dim=-1) for other in (c, d))
    angles = dihedral_angles(p, hinges)
    return torch.stack((torch.zeros_like(angles) if flat else angles, edge.square().sum(-1) / areas), -1)


class DihedralBending(EnergyTerm):
    """Energy ½ B Σ (‖e‖² / (A₁ + A₂)) (θ - θ₀)² of the angles θ at inner edges; B [N·m].

    The rest shape is that of ``rest_hinges``. On equilateral triangles B is the flexural rigidity of a sheet
    that is bent to a cylinder (a hinge's stiffness times √3/2: Seung and Nelson, Defects in flexible
    membranes, 1988). The energy of hinges depends on the mesh: squares that are all cut the same way twist as
    they bend, and a free strip of them has 0.8 B.
    """

    name: ClassVar[str] = "dihedral_bending"
    parameters: ClassVar[tuple[Parameter, ...]] = (Parameter("bending", "B", "N·m"),)
    n_coefficients: ClassVar[int] = 1

    def energy(self, positions: Tensor, coefficients: Tensor, factors: Tensor, rest: Tensor) -> Tensor:
        """See EnergyTerm."""
        away = dihedral_angles(positions, self.stencil) - rest[:, 0]
        return 0.5 * (coefficients * factors * rest[:, 1] * away.square()).sum(-1)

    def kernels(self) -> TermKernels:
        """See EnergyTerm."""
        from toile.physics.energies.dihedral_bending_kernels import (
            dihedral_bending_derivatives,
            dihedral_bending_energies,
        )

        return TermKernels(dihedral_bending_energies, dihedral_bending_derivatives)
