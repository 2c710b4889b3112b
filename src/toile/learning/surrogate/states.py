"""The states of many cloths at once."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from toile.learning.surrogate.pinned_corners import corner_indices


@dataclass(frozen=True)
class ClothStates:
    """n cloths on an H×W grid in network units; every tensor has n as its first dimension.

    Positions are float64: with stiff springs, the last digit of a float32 position is more than its weight.

    Attributes:
        history: (n, 4, H, W, 3) float64, x_n, x_{n-1}, ..., the centroid of x_n at 0.
        age: (n,) int64, steps since the start.
        bdf2: (n,) bool, the integrator: BDF2 or backward Euler.
        stiffness: (n, 3), Y, S, B.
        rest_lengths_i: (n, H-1, W).
        rest_lengths_j: (n, H, W-1).
        steady: (n, 3), acceleration by gravity and wind.
        turbulence: (n, k, k, 3), further acceleration on a coarse grid.
        turbulence_strength: (n,).
        pinned: (n, 4) bool, corners.
        corner_velocities: (n, 4, 3), per step.
        corner_speed: (n,).
    """

    history: Tensor
    age: Tensor
    bdf2: Tensor
    stiffness: Tensor
    rest_lengths_i: Tensor
    rest_lengths_j: Tensor
    steady: Tensor
    turbulence: Tensor
    turbulence_strength: Tensor
    pinned: Tensor
    corner_velocities: Tensor
    corner_speed: Tensor

    def __len__(self) -> int:
        return len(self.age)

    @property
    def grid(self) -> tuple[int, int]:
        """(H, W)."""
        return self.history.shape[2], self.history.shape[3]

    def take(self, indices: Tensor) -> ClothStates:
        """Copies of some cloths; indices (m,) int64."""
        return ClothStates(**{name: tensor[indices] for name, tensor in self.tensors().items()})

    def put(self, indices: Tensor, states: ClothStates) -> None:
        """Replace some cloths in place; no index twice."""
        others = states.tensors()
        for name, tensor in self.tensors().items():
            tensor[indices] = others[name]

    def tensors(self) -> dict[str, Tensor]:
        """The tensors by name, not copied."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @property
    def free(self) -> Tensor:
        """1 at free vertices, 0 at pinned ones, (n, H, W)."""
        height, width = self.grid
        free = torch.ones(len(self), height, width, device=self.pinned.device)
        rows, columns = corner_indices(self.grid)
        free[:, rows, columns] = 1 - self.pinned.float()
        return free
