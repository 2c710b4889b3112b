"""Membrane energies of constant-strain triangles.

A triangle's deformation gradient F (3×2) maps its rest shape in the plane to space; C = FᵀF, E = (C - I) / 2,
J = √det C, the ratio of areas. Both energies are linear in Lamé's constants of plane stress,

    λ = Y ν / (1 - ν²),   μ = Y / (2 (1 + ν)),

where Y is Young's modulus times the thickness [N/m] and ν is Poisson's ratio, and both have the stress of
linear elasticity at small strains.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

import torch
from torch import Tensor

from toile.physics.energies.term import EnergyTerm, TermKernels
from toile.physics.parameter_vector import Parameter


def lame_constants(young: Tensor, poisson: Tensor) -> Tensor:
    """λ and μ [N/m] of plane stress, (..., 2), from Y [N/m] and ν (...)."""
    return torch.stack((young * poisson / (1 - poisson**2), young / (2 * (1 + poisson))), -1)


def rest_triangles(positions: Tensor, faces: Tensor) -> Tensor:
    """Rest shapes of the triangles of a mesh, (T, 4).

    The first edge of a triangle lies along the first axis of its plane. Its two edges from vertex 0, as
    columns, are an upper triangular matrix; the entries (0, 0), (0, 1) and (1, 1) of the inverse [1/m] come
    first, then the area [m²].

    Args:
        positions: at rest (N, 3) [m], or (N, 2) of a flat pattern.
        faces: (T, 3).

    Raises:
        ValueError: a triangle has no area.
    """
    p = positions.to(torch.float64)[faces]
    first, second = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    length = first.norm(dim=-1)
    along = (second * first).sum(-1) / length
    height = (second - along[:, None] * (first / length[:, None])).norm(dim=-1)
    flat = ~(height > 1e-9 * length)
    if bool(flat.any()):
        raise ValueError(
            f"faces: expected triangles with an area at rest, got none in {int(flat.nonzero()[0])}"
        )
    return torch.stack((1 / length, -along / (length * height), 1 / height, 0.5 * length * height), -1)


def deformation_gradients(positions: Tensor, faces: Tensor, rest: Tensor) -> tuple[Tensor, Tensor]:
    """The two columns of F, (..., T, 3) each, from positions (..., N, 3) and rest_triangles (T, 4)."""
    p = positions[..., faces, :]
    first, second = p[..., 1, :] - p[..., 0, :], p[..., 2, :] - p[..., 0, :]
    return rest[:, 0:1] * first, rest[:, 1:2] * first + rest[:, 2:3] * second


class Membrane(EnergyTerm):
    """Resistance of triangles to in-plane strain; the rest shape is that of ``rest_triangles``."""

    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("young", "Y", "N/m"),
        Parameter("poisson", "ν", "", 0.0, 0.95),
    )
    n_coefficients: ClassVar[int] = 2

    def coefficients(self, values: Tensor) -> Tensor:
        """See EnergyTerm: λ and μ [N/m]."""
        return lame_constants(values[..., 0], values[..., 1])

    @abstractmethod
    def density(self, c11: Tensor, c12: Tensor, c22: Tensor) -> tuple[Tensor, Tensor]:
        """What multiplies λ and μ in the energy per rest area, from the entries of C."""

    def energy(self, positions: Tensor, coefficients: Tensor, factors: Tensor, rest: Tensor) -> Tensor:
        """See EnergyTerm."""
        first, second = deformation_gradients(positions, self.stencil, rest)
        entries = [(a * b).sum(-1) for a, b in ((first, first), (first, second), (second, second))]
        with_lambda, with_mu = self.density(*entries)
        weight = factors * rest[:, 3]
        return (weight * (coefficients[..., :1] * with_lambda + coefficients[..., 1:] * with_mu)).sum(-1)


class StVenantKirchhoff(Membrane):
    """Energy per area μ tr E² + λ/2 (tr E)²; weakens under compression, exact in uniform strain tests."""

    name: ClassVar[str] = "st_venant_kirchhoff"

    def density(self, c11: Tensor, c12: Tensor, c22: Tensor) -> tuple[Tensor, Tensor]:
        """See Membrane."""
        e11, e12, e22 = (c11 - 1) / 2, c12 / 2, (c22 - 1) / 2
        return 0.5 * (e11 + e22) ** 2, e11**2 + 2 * e12**2 + e22**2

    def kernels(self) -> TermKernels:
        """See EnergyTerm."""
        from toile.physics.energies.membrane_kernels import (
            st_venant_kirchhoff_derivatives,
            st_venant_kirchhoff_energies,
        )

        return TermKernels(st_venant_kirchhoff_energies, st_venant_kirchhoff_derivatives)


class NeoHookean(Membrane):
    """Energy per area μ/2 (tr C - 2) - μ (J - 1) + (λ + μ)/2 (J - 1)²: the stable neo-Hookean membrane.

    Smith, de Goes and Kim, Stable Neo-Hookean Flesh Simulation, 2018, for a surface: finite for a collapsed
    triangle, at rest without stress, and with λ + μ in place of λ, so that small strains see λ and μ.
    """

    name: ClassVar[str] = "neo_hookean"

    def density(self, c11: Tensor, c12: Tensor, c22: Tensor) -> tuple[Tensor, Tensor]:
        """See Membrane."""
        e11, e12, e22 = (c11 - 1) / 2, c12 / 2, (c22 - 1) / 2
        trace, determinant = e11 + e22, e11 * e22 - e12**2
        ratio = (c11 * c22 - c12**2).clamp(min=1e-12).sqrt()
        # J - 1 and (tr C - 2) / 2 - (J - 1) without the cancellation at small strains.
        away = 2 * (trace + 2 * determinant) / (1 + ratio)
        return 0.5 * away**2, (trace * away - 4 * determinant) / (1 + ratio) + 0.5 * away**2

    def kernels(self) -> TermKernels:
        """See EnergyTerm."""
        from toile.physics.energies.membrane_kernels import neo_hookean_derivatives, neo_hookean_energies

        return TermKernels(neo_hookean_energies, neo_hookean_derivatives)
