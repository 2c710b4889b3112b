"""Gravity tilt: the camera was not pinned as level as the scene says."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from toile.effects.base import ForceEffect, Parameter, Scope, Stage, Surroundings
from toile.geometry.horizontal import horizontal_axes


class GravityTilt(ForceEffect):
    """Gravity turned about the two horizontal axes, the first one first; its strength stays."""

    NAME: ClassVar[str] = "gravity_tilt"
    STAGE: ClassVar[Stage] = Stage.MECHANICS
    SCOPE: ClassVar[Scope] = Scope.DEVICE
    PARAMETERS: ClassVar[tuple[Parameter, ...]] = (
        Parameter("about_x", "deg", -45.0, 45.0, 3.0, "about the camera's x axis, made horizontal"),
        Parameter("about_z", "deg", -45.0, 45.0, 3.0, "about the horizontal axis across that one"),
    )
    SOURCE: ClassVar[str] = (
        "Rodrigues' rotation formula: Murray, Li and Sastry, A Mathematical Introduction to Robotic "
        "Manipulation, 1994"
    )

    def acceleration(self, times: Tensor, around: Surroundings) -> Tensor:
        """See ForceEffect."""
        gravity = around.gravity
        tilted = gravity
        for axis, angle in zip(horizontal_axes(gravity), torch.deg2rad(self.values), strict=True):
            turned = torch.linalg.cross(axis, tilted)
            along = (axis @ tilted) * axis
            tilted = tilted * torch.cos(angle) + turned * torch.sin(angle) + along * (1 - torch.cos(angle))
        return (tilted - gravity).expand(len(times), 1, 3)
