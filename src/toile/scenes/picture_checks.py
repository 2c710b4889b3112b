"""What is suspicious about the pictures of a clip: duplicates, and a camera that moves."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from toile.scenes.findings import Finding, Severity, named

Grey = npt.NDArray[np.uint8]

DUPLICATE = 0.1
"""Of the changes around it, below which a change from one picture to the next is none. A copy that was
encoded again changes by a few hundredths of what motion changes; a cloth that turns round keeps moving."""

AROUND = 3
"""Frames before and after that count as around, so that pictures shown three times are still found."""

MOVED = 1.0
"""Pixels (of a picture at most 960 px wide) by which half of the background must have moved. On a tripod the
tracking itself is wrong by a tenth of that; a pixel is about what a fit resolves."""

_LARGEST_SIDE = 960  # px, of the pictures that are compared for motion of the camera
_COMPARED = 12  # frames that are compared with frame 0
_FEWEST_POINTS = 12  # of the background: a median of fewer is chance
_TRACKED = 0.25  # of the points, which must be found again
_MOST_POINTS = 300
_CONTRAST = 6.0  # levels, standard deviation around a point: below is noise
_ALIKE = 10.0  # levels, mean difference of a point's surroundings in two pictures: above is another point
_RETURNED = 0.5  # px, by which a point tracked there and back may miss its start
_MARGIN = 0.02  # of the longer side, around the masks: what the cloth hides or shades


class PictureChecks:
    """Looks at the frames of a clip one after the other, and says at the end what is suspicious.

    Where nothing outside the masks has contrast (a cloth before black), nothing is said about the camera.

    Args:
        n_frames: number of frames that will come, to spread the work; None if unknown.
    """

    def __init__(self, n_frames: int | None) -> None:
        self._n_frames = n_frames
        self._before: Grey | None = None
        self._changes: list[float] = []
        self._count = 0
        self._first: Grey | None = None
        self._points: npt.NDArray[np.float32] = np.zeros((0, 1, 2), np.float32)
        self._shifts: dict[int, float] = {}

    def add(self, frame: npt.NDArray[np.uint8], mask: npt.NDArray[np.bool_]) -> None:
        """The next frame (h, w, 3) and its mask (h, w)."""
        import cv2

        grey = np.asarray(cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY), np.uint8)
        if self._before is not None:
            self._changes.append(float(cv2.absdiff(grey, self._before).mean()))
        self._before = grey
        if self._count == 0:
            self._start(grey, mask)
        elif self._is_compared(self._count) and len(self._points) >= _FEWEST_POINTS:
            self._compare(grey, mask)
        self._count += 1

    def findings(self, where: str) -> list[Finding]:
        """Warnings for everything seen so far.

        Args:
            where: file or folder, for messages.
        """
        return [*self._duplicates(where), *self._moved(where)]

    def _duplicates(self, where: str) -> list[Finding]:
        changes = np.array(self._changes)
        copies = [
            k + 1
            for k, change in enumerate(changes)
            # At either end nothing tells a copy from a cloth that rests.
            if 0 < k < len(changes) - 1
            and change < DUPLICATE * changes[max(k - AROUND, 0) : k].max()
            and change < DUPLICATE * changes[k + 1 : k + 1 + AROUND].max()
        ]
        if not copies:
            return []
        return [
            Finding(
                Severity.WARNING,
                "Frames are duplicates of the frame before",
                f"{where}: {named(copies)}",
                f"changes above {DUPLICATE:g} of those around; leave them out, with their times",
                f"{len(copies)} of {self._count} frames, a change of {changes[copies[0] - 1]:.2g} levels "
                f"where {np.median(changes):.2g} is usual",
            )
        ]

    def _moved(self, where: str) -> list[Finding]:
        moved = {k: shift for k, shift in self._shifts.items() if shift > MOVED * self._scale}
        if not moved:
            return []
        frame = max(moved, key=lambda k: moved[k])
        return [
            Finding(
                Severity.WARNING,
                "The camera seems to move",
                f"{where}: frame {frame}",
                f"a background that stays within {MOVED * self._scale:.1f} px of frame 0 (a tripod)",
                f"{moved[frame]:.1f} px, median of {len(self._points)} points outside the masks; "
                f"{len(moved)} of {len(self._shifts)} frames looked at",
            )
        ]

    def _is_compared(self, k: int) -> bool:
        if self._n_frames is None:
            return k % _COMPARED == 0
        return k in np.linspace(1, self._n_frames - 1, _COMPARED).round()

    def _start(self, grey: Grey, mask: npt.NDArray[np.bool_]) -> None:
        import cv2

        self._scale = max(1.0, max(grey.shape) / _LARGEST_SIDE)
        self._first = self._small(grey)
        outside = self._outside(mask)
        smooth = cv2.blur(self._first.astype(np.float32), (15, 15))
        squares = cv2.blur(np.square(self._first.astype(np.float32)), (15, 15))
        outside[squares - smooth**2 < _CONTRAST**2] = 0
        found = cv2.goodFeaturesToTrack(self._first, _MOST_POINTS, 0.01, 8, mask=outside)
        if found is not None:
            self._points = np.asarray(found, np.float32).reshape(-1, 1, 2)

    def _compare(self, grey: Grey, mask: npt.NDArray[np.bool_]) -> None:
        assert self._first is not None
        now = self._small(grey)
        there, found = _tracked(self._first, now, self._points)
        back, returned = _tracked(now, self._first, there)
        good = found & returned
        good &= np.linalg.norm((back - self._points).reshape(-1, 2), axis=1) < _RETURNED
        outside = self._outside(mask)
        h, w = now.shape
        x, y = np.nan_to_num(there.reshape(-1, 2)).round().astype(int).T
        good &= (x >= 0) & (x < w) & (y >= 0) & (y < h)
        good &= outside[np.clip(y, 0, h - 1), np.clip(x, 0, w - 1)] > 0
        if good.sum() >= max(_FEWEST_POINTS, _TRACKED * len(good)):
            moved = np.linalg.norm((there - self._points).reshape(-1, 2)[good], axis=1)
            # Of the distances, not of the vectors: a zoom or a turn has no median vector.
            self._shifts[self._count] = self._scale * float(np.median(moved))

    def _small(self, grey: Grey) -> Grey:
        import cv2

        if self._scale == 1:
            return grey
        size = round(grey.shape[1] / self._scale), round(grey.shape[0] / self._scale)
        return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.uint8)

    def _outside(self, mask: npt.NDArray[np.bool_]) -> Grey:
        """255 where the background is, some way off the cloth, in the small picture."""
        import cv2

        inside = self._small(np.where(mask, 255, 0).astype(np.uint8))
        reach = 2 * round(_MARGIN * max(inside.shape)) + 1
        grown = cv2.dilate(inside, np.ones((reach, reach), np.uint8))
        return np.where(grown > 0, 0, 255).astype(np.uint8)


def _tracked(
    before: Grey, after: Grey, points: npt.NDArray[np.float32]
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_]]:
    """Where the points (n, 1, 2) [px] are in the other picture, and which were found there, alike (n,)."""
    import cv2

    there, found, difference = cv2.calcOpticalFlowPyrLK(before, after, points, points.copy())
    alike = np.asarray(difference).ravel() < _ALIKE
    return np.asarray(there, np.float32), (np.asarray(found).ravel() > 0) & alike
