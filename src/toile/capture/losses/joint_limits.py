"""Limits of the joint angles, for PoseNet."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def joint_limit_loss(angles: Tensor, limits: Tensor) -> Tensor:
    """Σ_j Σ_axis (by how much the angle is beyond its limit)², mean over frames.

    Angles that differ by 2π are the same pose and have the same loss: an angle is beyond the limit that is
    nearer around the circle. An axis with only one limit is no circle.

    Args:
        angles: θ (B, D, 3) [rad].
        limits: least and largest (D, 3, 2) [rad], infinite where there is none, e.g.
            ``subject.joint_limits[deformation.driven]``.

    Returns:
        Scalar [rad²].
    """
    low, high = limits.to(angles).unbind(-1)
    both = torch.isfinite(low) & torch.isfinite(high)
    middle = torch.where(both, (low + high) / 2, 0.0)
    away = angles - middle
    turns = torch.where(both, torch.round(away.detach() / (2 * math.pi)), 0.0)
    away = away - 2 * math.pi * turns
    beyond = (low - middle - away).clamp(min=0) + (away - (high - middle)).clamp(min=0)
    return beyond.square().sum((1, 2)).mean()
