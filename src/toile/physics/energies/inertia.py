"""Inertia term (paper, Eq. 11)."""

from __future__ import annotations

from torch import Tensor


def inertia_potential(accelerations: Tensor, masses: Tensor, time_step: float) -> Tensor:
    """L_inert = ½ Δt² Σ <a, M a>; accelerations (..., N, 3) [m/s²], masses (N,) [kg]; returns (...) [J]."""
    return 0.5 * time_step**2 * (masses[:, None] * accelerations.square()).sum((-1, -2))
