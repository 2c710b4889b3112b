"""One implicit step on a grid in network units: what the surrogate is trained on and asked to solve.

    Φ(x) = ½ ‖x - x̂‖²_M + E(x; Y, S, B) - <f, x>        (paper, Eq. 4, divided by Δt²)

Units (paper, 3.1.3): an edge is 1 long, an interior vertex weighs 1 and the effective step β h takes 1, so
that backward Euler, BDF2 and any number of sub-steps are the same problem with other stiffness and forces.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from toile.physics.surrogate import kernels


@dataclass(frozen=True)
class StepProblem:
    """A batch of B steps on H×W grids; positions (prediction, starts) in float64, everything else in float32.

    Attributes:
        prediction: x̂ of the integrator, (B, H, W, 3).
        starts: candidate starts, pinned vertices already at their boundary positions, (B, G, H, W, 3).
        forces: f, external force, gravity included, (B, H, W, 3).
        stiffness: Y, S, B; (B, 3).
        masses: 1 inside, ½ on the border, ¼ at corners; (H, W).
        free: 1 where a vertex may move, 0 where it is pinned; (B, H, W).
        rest_lengths_i: of edges along grid axis 0, (B, H-1, W).
        rest_lengths_j: of edges along grid axis 1, (B, H, W-1).
    """

    prediction: Tensor
    starts: Tensor
    forces: Tensor
    stiffness: Tensor
    masses: Tensor
    free: Tensor
    rest_lengths_i: Tensor
    rest_lengths_j: Tensor

    def __post_init__(self) -> None:
        batch, height, width, _ = self.prediction.shape
        for name, expected in (
            ("starts", (batch, self.starts.shape[1], height, width, 3)),
            ("forces", (batch, height, width, 3)),
            ("stiffness", (batch, 3)),
            ("masses", (height, width)),
            ("free", (batch, height, width)),
            ("rest_lengths_i", (batch, height - 1, width)),
            ("rest_lengths_j", (batch, height, width - 1)),
        ):
            got = tuple(getattr(self, name).shape)
            if got != expected:
                raise ValueError(f"{name}: expected shape {expected}, got {got}")

    def residual(self, positions: Tensor) -> Tensor:
        """Out-of-balance force -∇Φ (Eq. 13) at positions (B, H, W, 3); zero at pinned vertices."""
        internal = kernels.energy_gradient(
            positions, self.stiffness, self.rest_lengths_i, self.rest_lengths_j
        )
        inertia = self.masses[..., None] * (self.prediction - positions).float()
        return (inertia + self.forces - internal) * self.free[..., None]

    def potential(self, positions: Tensor) -> Tensor:
        """Φ at positions (B, H, W, 3), up to a constant; (B,) float64."""
        numbers = (k.detach().float() for k in (self.stiffness, self.rest_lengths_i, self.rest_lengths_j))
        energies = kernels.energies(positions, *numbers)
        away = positions - self.prediction
        inertia = 0.5 * (self.masses[..., None] * away.square()).sum((1, 2, 3))
        # Relative to x̂, so that a cloth far from the origin loses no digits.
        return inertia + energies.sum(-1) - (self.forces * away).sum((1, 2, 3))

    def relaxation(self, positions: Tensor, residual: Tensor) -> Tensor:
        """Displacement (B, H, W, 3) that settles stretching along every warp and weft line."""
        return kernels.tangential_relaxation(positions, self.stiffness, residual, self.masses, self.free)

    def line_step(self, positions: Tensor, residual: Tensor, axis: int) -> Tensor:
        """Displacement (B, H, W, 3) that every line along the axis would make for itself."""
        return kernels.line_relaxation(
            positions,
            self.stiffness,
            residual,
            self.rest_lengths_i,
            self.rest_lengths_j,
            self.masses,
            self.free,
            axis,
        )

    def tensions(self, positions: Tensor) -> Tensor:
        """Tensions at every vertex, (B, H, W, 3), see ``kernels.tensions``."""
        return kernels.tensions(positions, self.stiffness, self.rest_lengths_i, self.rest_lengths_j)

    def vertex_inputs(
        self, positions: Tensor, residual: Tensor, tension: Tensor, pinned: Tensor, level: int
    ) -> tuple[Tensor, Tensor]:
        """Frames and inputs of the network on a coarsened grid, see ``kernels.vertex_inputs``."""
        return kernels.vertex_inputs(positions, residual, tension, pinned, self.masses, self.stiffness, level)

    def best_start(self) -> Tensor:
        """The candidate start of lowest Φ, one for each problem, (B, H, W, 3)."""
        with torch.no_grad():
            values = torch.stack([self.potential(start) for start in self.starts.unbind(1)], 1)
            best = torch.nan_to_num(values, nan=torch.inf).argmin(1)
        return self.starts[torch.arange(len(best), device=best.device), best]
