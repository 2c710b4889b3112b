"""Angle between two edges, accurate and smooth where cosines are not."""

from __future__ import annotations

import torch
from torch import Tensor

_SMALL = 1e-12


def angle_between(u: Tensor, v: Tensor) -> Tensor:
    """Unsigned angle in [0, π] between vectors (..., 3), by atan2 of sine and cosine.

    The gradient is zero (not NaN) where the two are exactly parallel.
    """
    sine_squared = torch.linalg.cross(u, v).square().sum(-1)
    parallel = sine_squared <= _SMALL * u.square().sum(-1) * v.square().sum(-1)
    sine = torch.where(parallel, torch.ones_like(sine_squared), sine_squared).sqrt()
    cosine = (u * v).sum(-1)
    straight = torch.where(cosine > 0, torch.zeros_like(cosine), torch.full_like(cosine, torch.pi))
    return torch.where(parallel, straight, torch.atan2(sine, cosine))


def squared_angle(u: Tensor, v: Tensor) -> Tensor:
    """Squared angle θ² between vectors (..., 3), twice differentiable at θ = 0 by its series in 1 - cos θ."""
    cosine = (u * v).sum(-1) / (u.norm(dim=-1) * v.norm(dim=-1))
    # 1 - cos θ as half the squared distance of the unit vectors: no cancellation for nearly parallel edges.
    defect = 0.5 * (u / u.norm(dim=-1, keepdim=True) - v / v.norm(dim=-1, keepdim=True)).square().sum(-1)
    small = defect < 1e-3
    series_argument = torch.where(small, defect, torch.zeros_like(defect))
    # arccos(1-d)² = 2d + d²/3 + 4d³/45 + d⁴/35 + 16d⁵/1575 + ...
    s = series_argument
    series = s * (2 + s * (1 / 3 + s * (4 / 45 + s * (1 / 35 + s * 16 / 1575))))
    safe = torch.where(small, torch.zeros_like(cosine), cosine).clamp(-1 + 1e-12, 1 - 1e-12)
    return torch.where(small, series, torch.arccos(safe) ** 2)
