"""State of a moving cloth."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class State:
    """Positions and motion of a batch of B cloths with N vertices.

    Attributes:
        positions: x_n, (B, N, 3) [m].
        velocities: v_n, (B, N, 3) [m/s].
        past: x_{n-1}, x_{n-2}, ... at the same time step, (B, K, N, 3) [m]; multistep methods read it.
        steps: steps taken since ``start``; multistep methods begin with formulas of their own.
        began: when the first of them began, since frame 0 (B,) [s]; 0 where ``start`` is not told.
    """

    positions: Tensor
    velocities: Tensor
    past: Tensor
    steps: int
    began: Tensor

    @staticmethod
    def start(
        positions: Tensor,
        velocities: Tensor,
        time_step: float,
        n_past: int,
        began: Tensor | None = None,
    ) -> State:
        """State whose past is the straight line through positions at the given velocities."""
        steps = torch.arange(1, n_past + 1, dtype=positions.dtype, device=positions.device)
        past = positions[:, None] - steps[None, :, None, None] * time_step * velocities[:, None]
        return State(
            positions, velocities, past, 0, positions.new_zeros(len(positions)) if began is None else began
        )
