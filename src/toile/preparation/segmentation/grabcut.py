"""GrabCut (Rother et al., SIGGRAPH 2004), started by hand in frame 0 and carried along by optical flow."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import numpy as np
import numpy.typing as npt

from toile.errors import InputError
from toile.limits import Count, NonNegative, Positive, Unit
from toile.preparation.segmentation.base import Segmentation, Segmented
from toile.preparation.segmentation.cleaning import Cleaning, Mask
from toile.preparation.video import Frame

Labels = npt.NDArray[np.uint8]
Area = tuple[slice, slice]

SAMPLES = 5
"""Pixels that a colour model needs at least; OpenCV's has as many components."""


class GrabCut(Segmentation):
    """Colour models of cloth and background, and a cut along edges, in a band around where the cloth must be.

    In frame 0 that is around the polygon, or anywhere in the box. From then on it is around the mask of the
    frame before, moved by dense optical flow (DIS). What is deeper inside is cloth, what is farther outside
    is background, so that neither needs to differ in colour everywhere. Lengths are fractions of the square
    root of the cloth's area, so that they hold at any resolution.

    Args:
        cleaning: applied to every mask, and so to what the next frame starts from.
        box: [x0, y0, x1, y1] in px of frame 0, the whole cloth within and background around; or None.
        polygon: [[x, y], ...] in px of frame 0, the cloth's rough outline (its four corners will do where its
            sides are straight); or None. Exactly one of the two is given.
        band: half width of the undecided band from frame 1 on.
        first_band: half width of the undecided band around the polygon.
        margin: how far around that background is looked at.
        first_iterations: of frame 0.
        iterations: of every other frame.
    """

    def __init__(
        self,
        cleaning: Cleaning,
        box: Sequence[float] | None = None,
        polygon: Sequence[Sequence[float]] | None = None,
        band: Annotated[Positive, Unit("of the box")] = 0.02,
        first_band: Positive = 0.05,
        margin: NonNegative = 0.25,
        first_iterations: Count = 5,
        iterations: Count = 2,
    ) -> None:
        super().__init__(cleaning)
        if (box is None) == (polygon is None):
            raise InputError(
                "Cloth is not marked in frame 0" if box is None else "Cloth is marked twice in frame 0",
                where="method.box, method.polygon",
                expected="method.box=[x0,y0,x1,y1] or method.polygon=[[x,y],...] in px, one of the two; "
                "still=frame.png shows the frame with rulers",
                got="neither" if box is None else "both",
            )
        self.box = None if box is None else _checked_box(box)
        self.polygon = None if polygon is None else _checked_polygon(polygon)
        self.band, self.first_band, self.margin = band, first_band, margin
        self.first_iterations, self.iterations = first_iterations, iterations

    def segment(self, frame: Frame, number: int, previous: Segmented | None) -> Mask:
        """Mask (h, w) of a frame, from the colours in it and the mask of the frame before.

        Raises:
            InputError: box or polygon are outside the frame or leave no background.
        """
        h, w = frame.shape[:2]
        if previous is not None:
            expected = _moved(previous, frame, self.margin)
            if not expected.any():
                return expected
            return self._cut(frame, _band_around(expected, self.band), self.iterations)
        if self.box is not None:
            labels = _from_box(self.box, h, w)
        else:
            assert self.polygon is not None
            labels = _band_around(_filled(self.polygon, h, w), self.first_band)
        return self._cut(frame, labels, self.first_iterations)

    def _cut(self, frame: Frame, labels: Labels, iterations: int) -> Mask:
        import cv2

        part = _area_around(labels != cv2.GC_BGD, self.margin)
        cut = np.ascontiguousarray(labels[part])
        inside = (cut == cv2.GC_FGD) | (cut == cv2.GC_PR_FGD)
        mask = np.zeros(labels.shape, dtype=np.bool_)
        if min(inside.sum(), (~inside).sum()) < SAMPLES:
            mask[part] = inside
            return mask
        # The colour models start from random clusters; the same clip shall give the same masks.
        cv2.setRNGSeed(0)
        models = np.zeros((2, 1, 65))
        picture, unused = np.ascontiguousarray(frame[part]), (0, 0, 0, 0)
        cv2.grabCut(picture, cut, unused, models[0], models[1], iterations, cv2.GC_INIT_WITH_MASK)
        mask[part] = (cut == cv2.GC_FGD) | (cut == cv2.GC_PR_FGD)
        return mask


def _checked_box(box: Sequence[float]) -> tuple[int, int, int, int]:
    if len(box) != 4 or not (box[0] < box[2] and box[1] < box[3]):
        raise InputError(
            "Box is no box",
            where="method.box",
            expected="[x0, y0, x1, y1] in px with x0 < x1 and y0 < y1",
            got=str(list(box)),
        )
    x0, y0, x1, y1 = (round(value) for value in box)
    return x0, y0, x1, y1


def _checked_polygon(polygon: Sequence[Sequence[float]]) -> npt.NDArray[np.float64]:
    if len(polygon) < 3 or any(len(corner) != 2 for corner in polygon):
        raise InputError(
            "Polygon is no polygon",
            where="method.polygon",
            expected="[[x, y], ...] in px, at least three corners",
            got=str([list(corner) for corner in polygon]),
        )
    return np.array([list(corner) for corner in polygon], dtype=np.float64)


def _from_box(box: tuple[int, int, int, int], h: int, w: int) -> Labels:
    """All of the box (x0, y0, x1, y1) is likely cloth, the rest (h, w) surely background."""
    import cv2

    x0, y0, x1, y1 = box
    if x0 < 0 or y0 < 0 or x1 > w or y1 > h:
        raise InputError(
            "Box is outside the frame",
            where="method.box",
            expected=f"0 <= x <= {w} and 0 <= y <= {h}",
            got=str(list(box)),
        )
    if (x1 - x0) * (y1 - y0) > h * w - SAMPLES:
        raise InputError(
            "Box leaves no background",
            where="method.box",
            expected=f"a part of the {w} x {h} px frame, close around the cloth",
            got=str(list(box)),
        )
    labels = np.full((h, w), cv2.GC_BGD, dtype=np.uint8)
    labels[y0:y1, x0:x1] = cv2.GC_PR_FGD
    return labels


def _filled(polygon: npt.NDArray[np.float64], h: int, w: int) -> Mask:
    """Inside (h, w) of a polygon (n, 2) of (x, y) [px]."""
    import cv2

    if (polygon < 0).any() or (polygon > (w, h)).any():
        raise InputError(
            "Polygon is outside the frame",
            where="method.polygon",
            expected=f"0 <= x <= {w} and 0 <= y <= {h}",
            got=str(polygon.tolist()),
        )
    inside = np.zeros((h, w), dtype=np.uint8)
    # OpenCV counts from the centre of a pixel.
    cv2.fillPoly(inside, [np.rint(polygon - 0.5).astype(np.int32)], 1)
    return inside > 0


def _band_around(mask: Mask, width: float) -> Labels:
    """Labels (h, w): undecided within ``width`` (fraction of the cloth's size) of the mask's border."""
    import cv2

    reach = max(2.0, width * np.sqrt(mask.sum()))
    depth = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    away = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    labels = np.where(mask, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    labels[depth > reach] = cv2.GC_FGD
    labels[away > reach] = cv2.GC_BGD
    return labels


def _moved(previous: Segmented, frame: Frame, margin: float) -> Mask:
    """The mask (h, w) of the frame before, moved to where its pixels are in ``frame``."""
    import cv2

    part = _area_around(previous.mask, margin)
    now, before = (
        cv2.cvtColor(np.ascontiguousarray(picture[part]), cv2.COLOR_RGB2GRAY)
        for picture in (frame, previous.frame)
    )
    moved = np.zeros_like(previous.mask)
    flow = np.zeros((*now.shape, 2), dtype=np.float32)
    cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM).calc(now, before, flow)
    y, x = np.indices(now.shape, dtype=np.float32)
    source = previous.mask[part].astype(np.float32)
    moved[part] = cv2.remap(source, x + flow[..., 0], y + flow[..., 1], cv2.INTER_LINEAR) > 0.5
    return moved


def _area_around(mask: Mask, margin: float) -> Area:
    """Rows and columns of a mask and ``margin`` (fraction of its size) around it."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    # Without any background nothing would be cut off.
    grow = max(1, int(np.ceil(margin * np.sqrt(mask.sum()))))
    return (
        slice(max(rows[0] - grow, 0), rows[-1] + 1 + grow),
        slice(max(columns[0] - grow, 0), columns[-1] + 1 + grow),
    )
