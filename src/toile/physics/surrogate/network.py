"""Gated convolutional U-Net that turns an out-of-balance force into a displacement (paper, 3.1.3, Figure 3).

Where it departs from the paper, and why:

- It sees the out-of-balance force of Eq. 13 at the current guess instead of the raw state. A guess that is
  right stays as it is, and a second pass of the same weights makes a good guess better.
- Vectors are seen and given in the frame of each vertex (warp, weft, normal): rotations and translations need
  not be learned. Magnitudes are divided out per sample and level and put back afterwards, so that the network
  answers to the scale of the forces by construction.
- Every level of the U-Net reads the force averaged to its grid and answers with a displacement of its own, so
  that slow motions of the whole cloth keep their digits beside stiff ripples.
- Of the two gates of the paper, one passes the force straight through (divided by the local stiffness: in
  free fall by the mass), the other the network's own, bounded answer.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from toile.physics.surrogate import kernels
from toile.physics.surrogate.problem import StepProblem

# Bound of a displacement in units of the local estimate: the acceleration stays bounded (paper, Figure 3).
_BOUND = 4.0
# Vertices along a side of a patch.
_PATCH = 2
_N_BOUNDED = 5
_N_GATES = 2
_N_SCALARS = 6


class ResidualBlock(nn.Module):
    """Two 3×3 convolutions beside the identity."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(width, width, 3, padding=1)
        self.second = nn.Conv2d(width, width, 3, padding=1)

    def forward(self, features: Tensor) -> Tensor:
        """(B, C, h, w) to (B, C, h, w)."""
        inner: Tensor = self.second(functional.silu(self.first(functional.silu(features))))
        return features + inner


class GatedUNet(nn.Module):
    """Maps positions and out-of-balance force to a displacement.

    Args:
        widths: channels of every level, the grid of half resolution first; each level halves the grid. The
            cloth's own grid is read and written as patches of 2×2 vertices.
    """

    def __init__(self, widths: Sequence[int]) -> None:
        super().__init__()
        if not widths or min(widths) < 1:
            raise ValueError(f"widths: expected at least one positive number of channels, got {list(widths)}")
        self.widths = tuple(int(w) for w in widths)
        pairs = list(zip(self.widths[:-1], self.widths[1:], strict=True))
        coarse = kernels.n_inputs(1)
        patches = _PATCH**2 * kernels.n_inputs(0)
        self.inputs = nn.ModuleList(
            nn.Conv2d(coarse + patches, w, 3, padding=1) if index == 0 else nn.Conv2d(coarse, w, 1)
            for index, w in enumerate(self.widths)
        )
        self.scalars = nn.ModuleList(
            nn.Linear(2 * _N_SCALARS if index == 0 else _N_SCALARS, w) for index, w in enumerate(self.widths)
        )
        self.down = nn.ModuleList(nn.Conv2d(fine, wide, 1) for fine, wide in pairs)
        self.encoders = nn.ModuleList(ResidualBlock(w) for w in self.widths)
        self.up = nn.ModuleList(nn.Conv2d(wide, fine, 1) for fine, wide in pairs)
        self.decoders = nn.ModuleList(ResidualBlock(w) for w in self.widths[:-1])
        self.heads = nn.ModuleList(_head(w, 1) for w in self.widths)
        self.vertex_head = _head(self.widths[0], _PATCH**2)

    @property
    def n_parameters(self) -> int:
        """Number of weights."""
        return sum(p.numel() for p in self.parameters())

    def forward(self, problem: StepProblem, positions: Tensor, residual: Tensor) -> Tensor:
        """Displacement (B, H, W, 3), zero at pinned vertices, differentiable in the weights.

        Args:
            problem: the step; a DifferentiableStepProblem makes the displacement differentiable in what it
                holds, and in positions and residual.
            positions: current guess (B, H, W, 3).
            residual: out-of-balance force there (B, H, W, 3).
        """
        own, *coarser = self._levels(problem, positions, residual)
        height, width = own.inputs.shape[1:3]
        patches = functional.pad(
            own.inputs.permute(0, 3, 1, 2), (0, width % _PATCH, 0, height % _PATCH), mode="replicate"
        )
        patches = functional.pixel_unshuffle(patches, _PATCH)
        skips: list[Tensor] = []
        h = patches
        for index, level in enumerate(coarser):
            z, scalars = level.inputs.permute(0, 3, 1, 2), level.scalars
            if index == 0:
                z, scalars = torch.cat((patches, z), 1), torch.cat((own.scalars, scalars), -1)
            z = self.inputs[index](z) + self.scalars[index](scalars)[:, :, None, None]
            if index:
                z = z + self.down[index - 1](_halve(h))
            h = self.encoders[index](z)
            skips.append(h)
        displacement: Tensor | None = None
        for index in range(len(coarser) - 1, -1, -1):
            level = coarser[index]
            size = level.inputs.shape[1:3]
            if index < len(coarser) - 1:
                h = skips[index] + self.up[index](_resize(h, size))
                h = self.decoders[index](h)
            here = level.displacement(self.heads[index](h).permute(0, 2, 3, 1))
            displacement = here if displacement is None else here + _resize_last(displacement, size)
        assert displacement is not None
        answer = functional.pixel_shuffle(self.vertex_head(h), _PATCH)[:, :, :height, :width]
        here = own.displacement(answer.permute(0, 2, 3, 1))
        return (here + _resize_last(displacement, (height, width))) * problem.free[..., None]

    def _levels(self, problem: StepProblem, positions: Tensor, residual: Tensor) -> list[_Level]:
        x, r, pinned = positions - positions.mean((1, 2), keepdim=True), residual, 1.0 - problem.free
        k = problem.stiffness
        tension = problem.tensions(positions)
        material = 0.2 * k.log() - 0.2 * k.new_tensor([5.0, 0.0, 0.0])
        levels = []
        for level in range(len(self.widths) + 1):
            if level:
                stacked = torch.cat((x.to(r.dtype), r, tension, pinned[..., None]), -1).permute(0, 3, 1, 2)
                stacked = _halve(stacked).permute(0, 2, 3, 1)
                x, r = stacked[..., :3].double(), stacked[..., 3:6]
                tension, pinned = stacked[..., 6:9], stacked[..., 9]
            frames, inputs = problem.vertex_inputs(x, r, tension, pinned, level)
            levels.append(_Level(frames, inputs, material))
        return levels


def _head(width: int, n_vertices: int) -> nn.Conv2d:
    """Bounded answers and gates of n vertices per grid point; the network starts by saying nothing."""
    head = nn.Conv2d(width, n_vertices * (_N_BOUNDED + _N_GATES), 1)
    # The direct path starts almost closed, the network's own wide open.
    start = torch.tensor([0.0] * _N_BOUNDED + [-2.0, 2.0])
    nn.init.zeros_(head.weight)
    with torch.no_grad():
        # Channel-major, as pixel_shuffle reads them.
        nn.Module.get_parameter(head, "bias").copy_(start.repeat_interleave(n_vertices))
    return head


class _Level:
    """Inputs of one level with their magnitudes divided out, and the way back."""

    def __init__(self, frames: Tensor, inputs: Tensor, material: Tensor) -> None:
        self.frames = frames
        force = _magnitude(inputs[..., 0:3])
        self.in_plane = _magnitude(inputs[..., 3:5])
        self.normal = _magnitude(inputs[..., 5:6])
        self.direct = inputs[..., 3:6]
        self.inputs = torch.cat(
            (
                _over(inputs[..., 0:3], force),
                _over(inputs[..., 3:5], self.in_plane),
                _over(inputs[..., 5:6], self.normal),
                inputs[..., 6:],
            ),
            -1,
        )
        logs = torch.cat((force, self.in_plane, self.normal), -1)[:, 0, 0].log()
        self.scalars = torch.cat((0.2 * logs, material), -1)

    def displacement(self, answer: Tensor) -> Tensor:
        """World displacement (B, h, w, 3) from the head's answer (B, h, w, 7)."""
        bounded = _BOUND * torch.tanh(answer[..., :_N_BOUNDED] / _BOUND)
        gates = torch.sigmoid(answer[..., _N_BOUNDED:])
        own = torch.cat(
            (
                self.in_plane * bounded[..., 0:2] + 0.3 * self.normal * bounded[..., 2:4],
                self.normal * bounded[..., 4:5],
            ),
            -1,
        )
        local = gates[..., 0:1] * self.direct + gates[..., 1:2] * own
        return (self.frames * local[..., None]).sum(-2)


# Keeps a cloth in perfect balance from dividing zero by zero.
_NOTHING = 1e-20


def _magnitude(vectors: Tensor) -> Tensor:
    squared = vectors.square().mean((1, 2, 3), keepdim=True)
    there = squared > 0
    return torch.where(there, torch.where(there, squared, 1.0).sqrt(), 0.0) + _NOTHING


def _over(vectors: Tensor, magnitude: Tensor) -> Tensor:
    """Magnitudes divided out; where there are none, vectors stay zero, and so do their derivatives."""
    return vectors / torch.where(magnitude > 2 * _NOTHING, magnitude, 1.0)


def _halve(grids: Tensor) -> Tensor:
    return functional.avg_pool2d(grids, 2, ceil_mode=True, count_include_pad=False)


def _resize_last(vectors: Tensor, size: Sequence[int]) -> Tensor:
    return _resize(vectors.permute(0, 3, 1, 2), size).permute(0, 2, 3, 1)


def _resize(grids: Tensor, size: Sequence[int]) -> Tensor:
    return functional.interpolate(grids, size=tuple(size), mode="bilinear", align_corners=False)
