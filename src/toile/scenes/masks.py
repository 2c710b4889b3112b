"""Cleaning of observed masks and the box they span."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor


@dataclass(frozen=True)
class Box:
    """Rows [top, top + height) and columns [left, left + width) of an image [px]."""

    top: int
    left: int
    height: int
    width: int

    def cut(self, image: Tensor) -> Tensor:
        """The part of an image (h, w, ...) inside the box."""
        return image[self.top : self.top + self.height, self.left : self.left + self.width]


def drop_small_components(mask: Tensor, minimum: float) -> tuple[Tensor, tuple[int, ...]]:
    """Remove connected components smaller than ``minimum`` times the largest one.

    A recorded mask may hold more than the cloth (R1 of φ-SfT: the two feet of the person who holds it).

    Args:
        mask: (h, w) uint8, 0 outside; a component is a 4-connected set of non-zero pixels.
        minimum: fraction of the largest component's size in [0, 1]; 0 keeps everything.

    Returns:
        The mask (a copy if anything was removed) and the sizes [px] of what was removed.
    """
    from scipy import ndimage

    if minimum <= 0:
        return mask, ()
    box = bounding_box(mask)
    labels, n = ndimage.label(box.cut(mask).numpy())
    if n < 2:
        return mask, ()
    sizes = np.bincount(labels.ravel(), minlength=n + 1)
    sizes[0] = 0
    keep = sizes >= minimum * sizes.max()
    keep[0] = True
    if keep.all():
        return mask, ()
    cleaned = mask.clone()
    box.cut(cleaned)[torch.from_numpy(~keep[labels])] = 0
    return cleaned, tuple(sorted((int(s) for s in sizes[~keep]), reverse=True))


def bounding_box(mask: Tensor, margin: int = 0) -> Box:
    """Box of the non-zero pixels of a mask (h, w), grown by ``margin`` px and clipped to the image.

    An empty mask gives the whole image.
    """
    h, w = mask.shape
    values = mask.numpy()
    rows, columns = np.flatnonzero(values.any(1)), np.flatnonzero(values.any(0))
    if len(rows) == 0:
        return Box(0, 0, h, w)
    top, left = max(int(rows[0]) - margin, 0), max(int(columns[0]) - margin, 0)
    bottom, right = min(int(rows[-1]) + 1 + margin, h), min(int(columns[-1]) + 1 + margin, w)
    return Box(top, left, bottom - top, right - left)


def outline_of(mask: Tensor, blur: float = 1.0) -> npt.NDArray[np.float64]:
    """The longest closed outline of a mask, (n, 2) [px], at the level 0.5 between pixel centres.

    Args:
        mask: (h, w), inside above 0.5; it may touch the image border.
        blur: standard deviation [px] of a Gaussian that takes off the steps of the pixels.
    """
    from contourpy import contour_generator
    from scipy import ndimage

    margin = 1 + int(4 * blur)
    soft = ndimage.gaussian_filter(np.pad((mask.numpy() > 0.5).astype(np.float64), margin), blur)
    lines = [np.asarray(line, dtype=np.float64) for line in contour_generator(z=soft).lines(0.5)]
    # Closed: the last point is the first one.
    longest = max(lines, key=len)[:-1]
    return longest - margin + 0.5
