"""What is done to every mask: the cloth is one piece, or a few, without holes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch

from toile.errors import InputError
from toile.limits import Fraction
from toile.scenes.masks import bounding_box, drop_small_components

Mask = npt.NDArray[np.bool_]
"""Mask (h, w), True on the cloth."""


@dataclass(frozen=True)
class Cleaning:
    """Removes small components and fills holes.

    Attributes:
        minimum_component: fraction of the largest component's area below which another is dropped; 1 keeps
            only the largest, 0 all.
        largest_hole: fraction of the mask's area up to which a hole is filled; 0 fills none, 1 all.
    """

    minimum_component: Fraction = 0.1
    largest_hole: Fraction = 1.0

    def __post_init__(self) -> None:
        """Check the two fractions."""
        for name in ("minimum_component", "largest_hole"):
            value = getattr(self, name)
            if not 0 <= value <= 1:
                raise InputError(f"{name} is no fraction", where=name, expected="0 to 1", got=f"{value:g}")

    def __call__(self, mask: Mask) -> Mask:
        """The cleaned mask (h, w)."""
        kept, _ = drop_small_components(torch.from_numpy(mask.astype(np.uint8)), self.minimum_component)
        return _without_holes(kept.numpy() > 0, self.largest_hole)


def _without_holes(mask: Mask, largest: float) -> Mask:
    from scipy import ndimage

    if largest <= 0 or not mask.any():
        return mask
    box = bounding_box(torch.from_numpy(mask))
    inside = np.s_[box.top : box.top + box.height, box.left : box.left + box.width]
    part = mask[inside]
    holes = ndimage.binary_fill_holes(part) & ~part
    if largest < 1:
        labels, n = ndimage.label(holes)
        sizes = np.bincount(labels.ravel(), minlength=n + 1)
        sizes[0] = 0
        holes = ((sizes > 0) & (sizes <= largest * mask.sum()))[labels]
    filled = mask.copy()
    filled[inside] |= holes
    return filled
