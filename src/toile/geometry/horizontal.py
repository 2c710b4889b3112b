"""The two horizontal directions of a scene, from its gravity."""

from __future__ import annotations

import torch
from torch import Tensor

from toile.errors import InputError

# Cosine between gravity and the camera's x axis from which on that axis says little of what is horizontal:
# the camera is rolled by more than 64°, a clip filmed upright.
_ROLLED = 0.9


def horizontal_axes(gravity: Tensor) -> Tensor:
    """Horizontal unit vectors (2, 3): to the right, and away from the camera.

    The first is the camera's x axis made horizontal (reversed where the camera is upside down). Where the
    camera is rolled so far that gravity points along that axis, the second is its z axis made horizontal, and
    the first the one to the right of it: a camera that is rolled about its optical axis by 90° or 180° sees
    the same directions as before.

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
    rolled = abs(float(down[0])) >= _ROLLED
    start = torch.eye(3, dtype=gravity.dtype)[2 if rolled else 0]
    if not rolled and float(down[1]) < 0:
        start = -start  # the camera is upside down
    level = start - (start @ down) * down
    level = level / level.norm()
    if rolled:
        return torch.stack((torch.linalg.cross(down, level), level))
    return torch.stack((level, torch.linalg.cross(level, down)))
