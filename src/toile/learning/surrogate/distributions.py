"""Random numbers that several samplers draw; everything comes from an explicit generator."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def uniform(n: int, generator: torch.Generator) -> Tensor:
    """Numbers in [0, 1), (n,)."""
    return torch.rand(n, generator=generator, device=generator.device)


def log_uniform(n: int, bounds: tuple[float, float], generator: torch.Generator) -> Tensor:
    """Numbers whose logarithm is uniform between two positive bounds, (n,)."""
    low, high = bounds
    return torch.exp(math.log(low) + uniform(n, generator) * math.log(high / low))


def normal(shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
    """Standard normal numbers of a shape."""
    return torch.randn(shape, generator=generator, device=generator.device)


def directions(n: int, generator: torch.Generator) -> Tensor:
    """Unit vectors, uniform on the sphere, (n, 3)."""
    return torch.nn.functional.normalize(normal((n, 3), generator), dim=-1)


def rotations(n: int, generator: torch.Generator) -> Tensor:
    """Rotation matrices, uniform (from normalised quaternions), (n, 3, 3)."""
    w, x, y, z = torch.nn.functional.normalize(normal((n, 4), generator), dim=-1).unbind(-1)
    entries = (
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack(entries, -1).reshape(n, 3, 3)
