"""Regularisation of the turbulent forces (paper, Eq. 17)."""

from __future__ import annotations

from typing import Literal, final

import torch
from torch import Tensor

from toile.errors import InputError
from toile.limits import NonNegative

Reduction = Literal["sum", "mean"]


@final
class ForceRegularization:
    """R_T = α Σ |T|² + β Σ |T_{t+1} - T_t|² + γ Σ (|T^{(i+1)j} - T^{ij}|² + |T^{i(j+1)} - T^{ij}|²).

    T is in network units of force: a force per interior vertex mass f [m/s²] has T = f Δt² / L, with Δt the
    time step of the network units and L the grid spacing.

    Two conventions are around, and they differ by a factor of about the number of vertices and frames: the
    paper prints sums, its published code takes means. ``reduction`` says which; "mean" divides each of the
    four sums by its number of vectors.

    Args:
        alpha: weight of the length.
        beta: weight of the change in time.
        gamma: weight of the change along the grid.
        reduction: "sum" or "mean".

    Raises:
        InputError: another reduction.
    """

    def __init__(
        self, alpha: NonNegative, beta: NonNegative, gamma: NonNegative, reduction: Reduction
    ) -> None:
        if reduction not in ("sum", "mean"):
            raise InputError(
                "Unknown convention of the force regularisation",
                where="reduction",
                expected="sum (as printed) or mean (as in the published code)",
                got=str(reduction),
            )
        self.alpha, self.beta, self.gamma, self.reduction = alpha, beta, gamma, reduction

    def __call__(self, turbulence: Tensor) -> Tensor:
        """Value for turbulent forces (n, H, W, 3) [network units], scalar."""
        return (
            self.alpha * self._reduce(turbulence)
            + self.beta * self._reduce(turbulence.diff(dim=0))
            + self.gamma * (self._reduce(turbulence.diff(dim=1)) + self._reduce(turbulence.diff(dim=2)))
        )

    def _reduce(self, vectors: Tensor) -> Tensor:
        total = vectors.square().sum()
        if self.reduction == "sum":
            return total
        return total / torch.tensor(max(1, vectors.numel() // 3), dtype=vectors.dtype)
