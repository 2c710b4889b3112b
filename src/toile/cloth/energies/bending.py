"""Bending energy (paper, Eq. 9)."""

from __future__ import annotations

from torch import Tensor

from toile.cloth.energies.angle import squared_angle


def bending_energy(positions: Tensor, straights: Tensor, stiffness: Tensor | float) -> Tensor:
    """Energy ½ B Σ θ² of the angles between consecutive edges of the same direction, flat at rest (θ₀ = 0).

    Args:
        positions: (..., N, 3) [m].
        straights: (S, 3) vertex indices (i, k, j).
        stiffness: B [N·m], broadcastable to (..., S).

    Returns:
        Energy [J], shape (...).
    """
    k = positions[..., straights[:, 1], :]
    squared = squared_angle(k - positions[..., straights[:, 0], :], positions[..., straights[:, 2], :] - k)
    return 0.5 * (stiffness * squared).sum(-1)
