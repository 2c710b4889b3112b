"""Stretching energy (paper, Eq. 7)."""

from __future__ import annotations

from torch import Tensor


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
    length = (positions[..., edges[:, 1], :] - positions[..., edges[:, 0], :]).norm(dim=-1)
    return 0.5 * (stiffness * (length - rest_lengths) ** 2).sum(-1)
