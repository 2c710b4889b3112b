"""The two horizontal directions of a scene, from its gravity."""

from __future__ import annotations

import torch
from torch import Tensor

from toile.errors import InputError


def horizontal_axes(gravity: Tensor) -> Tensor:
    """Horizontal unit vectors (2, 3): the camera's x axis made horizontal, and the one across it.

    With gravity along the camera's y axis (downwards) they are the camera's x (to the right) and z (forward).

    Args:
        gravity: (3,) [m/s²].

    Raises:
        InputError: there is no gravity.
    """
    strength = gravity.norm()
    if float(strength) == 0.0:
        raise InputError(
            "horizontal directions need a gravity",
            where="gravity of the scene",
            expected="a vector other than zero",
            got="zero",
        )
    down = gravity / strength
    start = torch.eye(3, dtype=gravity.dtype)[0 if abs(float(down[0])) < 0.9 else 2]
    first = torch.nn.functional.normalize(start - (start @ down) * down, dim=0)
    return torch.stack((first, torch.linalg.cross(first, down)))
