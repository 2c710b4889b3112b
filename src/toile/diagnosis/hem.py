"""The hem of a cloth: a strip along its borders that weighs more than thought, or less.

Every cloth has some, and where a mesh puts the mass of its outermost half cells differs. It is no cause of a
gap, but a density that varies would be found in its place.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toile.effects.base import MassEffect, Parameter, Stage, Surroundings

Array = NDArray[np.float64]

_LINEAR = 0.5
"""Share of its mass that a vertex loses as the strip says."""


class Hem(MassEffect):
    """Mass of a strip along all borders that lies double, in addition; negative: that is missing."""

    NAME: ClassVar[str] = "hem"
    STAGE: ClassVar[Stage] = Stage.MECHANICS
    PARAMETERS: ClassVar[tuple[Parameter, ...]] = (
        Parameter("width", "m", -0.05, 0.05, 0.0003, "of the strip; a hem is 3 mm, ten times the scale"),
    )
    SOURCE: ClassVar[str] = "ours: the smallest change of mass that a border without cells of its own allows"

    def masses(self, masses: Tensor, around: Surroundings) -> Tensor:
        """See MassEffect.

        Of what is missing no vertex loses all: from half of its mass on it loses less and less. Corners of a
        crowded grid, a few millimetres across, had a mass below zero.
        """
        if not self.is_active:
            return masses
        more = self.values[0] * torch.from_numpy(border_strip(around)) / masses
        return masses * torch.where(more > -_LINEAR, 1 + more, _falling(more))


def _falling(more: Tensor) -> Tensor:
    """What is left of a mass: an exponential that goes on from 1 + more at -_LINEAR with the same slope."""
    least = 1 - _LINEAR
    # Not above there, where it is not asked for and would overflow.
    return least * torch.exp((more.clamp(max=-_LINEAR) + _LINEAR) / least)


def border_strip(around: Surroundings) -> Array:
    """Mass that a strip of 1 m along all borders has more (N,) [kg].

    Args:
        around: a clip; its cloth is on a grid.
    """
    cloth = around.cloth
    assert cloth.grid is not None
    (H, W), (height, width) = cloth.grid, around.cloth_size
    density = float(cloth.masses.sum()) / (height * width)
    mass = np.zeros((H, W))
    first, second = (share.numpy() / (len(share) - 1) for share in cloth.lines.shares())
    mass[:, [0, -1]] += density * height * first[:, None]
    mass[[0, -1]] += density * width * second
    return mass.reshape(-1)
