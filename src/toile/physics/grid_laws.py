"""Laws of a cloth with warp and weft: which energies resist the deformation of a grid, flat at rest."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from toile.limits import Fraction
from toile.physics.energies.bending import Bending
from toile.physics.energies.shearing import Shearing
from toile.physics.energies.springs import DiagonalShearing, TautStretching
from toile.physics.energies.stretching import Stretching
from toile.physics.energies.term import InternalEnergy
from toile.physics.stencils import grid_stencils

GridLaw = Callable[[tuple[int, int], Tensor], InternalEnergy]
"""From (H, W) and the rest lengths (E,) [m] of the edges to the energies."""


def angles(grid: tuple[int, int], rest_lengths: Tensor) -> InternalEnergy:
    """The paper's: edges, the angles between them, straight lines (paper, Eqs. 7-9)."""
    stencils = grid_stencils(*grid)
    right = torch.full((len(stencils.corners),), torch.pi / 2, dtype=torch.float64)
    return InternalEnergy(
        (Stretching(stencils.edges, rest_lengths), Shearing(stencils.corners, right), _bending(grid))
    )


def taut(
    grid: tuple[int, int],
    rest_lengths: Tensor,
    edge_compression: Fraction = 0.5,
    diagonal_compression: Fraction = 0.0,
) -> InternalEnergy:
    """Edges and diagonals with compression ratios, see springs, and straight lines.

    Args:
        grid: (H, W).
        rest_lengths: of the edges (E,) [m].
        edge_compression: ratio of the edges, unless a material says otherwise.
        diagonal_compression: of the diagonals.
    """
    stencils = grid_stencils(*grid)
    return InternalEnergy(
        (
            TautStretching(stencils.edges, rest_lengths),
            DiagonalShearing(grid_diagonals(*grid), rest_diagonals(grid, rest_lengths)),
            _bending(grid),
        ),
        {"edge_compression": edge_compression, "diagonal_compression": diagonal_compression},
    )


def taut_fitted(
    grid: tuple[int, int],
    rest_lengths: Tensor,
    edge_compression: Fraction = 0.5,
    diagonal_compression: Fraction = 0.2,
) -> InternalEnergy:
    """The same where both ratios are fitted: none begins at 0, whose logarithm leads nowhere.

    Args:
        grid: (H, W).
        rest_lengths: of the edges (E,) [m].
        edge_compression: ratio of the edges where a fit begins.
        diagonal_compression: of the diagonals.
    """
    return taut(grid, rest_lengths, edge_compression, diagonal_compression)


def grid_diagonals(height: int, width: int) -> Tensor:
    """Both diagonals of every cell, (2 (H-1) (W-1), 2): those down the columns first."""
    v = torch.arange(height * width).reshape(height, width)
    pairs = ((v[:-1, :-1], v[1:, 1:]), (v[:-1, 1:], v[1:, :-1]))
    return torch.cat([torch.stack((a.reshape(-1), b.reshape(-1)), 1) for a, b in pairs])


def rest_diagonals(grid: tuple[int, int], rest_lengths: Tensor) -> Tensor:
    """Rest lengths of ``grid_diagonals`` [m]: warp and weft are orthogonal at rest.

    Args:
        grid: (H, W).
        rest_lengths: of the edges (E,) [m], those along axis 0 first.
    """
    h, w = grid
    first, second = rest_lengths.split([(h - 1) * w, h * (w - 1)])
    first, second = first.reshape(h - 1, w), second.reshape(h, w - 1)
    sides = (first[:, :-1] + first[:, 1:]) / 2, (second[:-1] + second[1:]) / 2
    diagonal = torch.hypot(*sides).reshape(-1)
    return torch.cat((diagonal, diagonal))


def _bending(grid: tuple[int, int]) -> Bending:
    straights = grid_stencils(*grid).straights
    return Bending(straights, torch.zeros(len(straights), dtype=torch.float64))
