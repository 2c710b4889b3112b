"""External term (paper, Eq. 10)."""

from __future__ import annotations

from torch import Tensor


def external_potential(accelerations: Tensor, forces: Tensor, time_step: float) -> Tensor:
    """L_ext = -Δt² Σ <F_ext, a>; accelerations and forces (..., N, 3) [m/s²], [N]; returns (...) [J]."""
    return -(time_step**2) * (forces * accelerations).sum((-1, -2))
