"""Which sub-steps lie between which frames: one constant sub-step, any number of them from frame to frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import ceil
from typing import Any

import numpy as np
import torch

from toile.errors import InputError

_SHORTEST_SHARE = 0.05
"""Of the shortest interval, by which a frame's time may be off at most: displacements between two frames are
then wrong by a tenth of themselves in the worst case, where both ends are off in opposite directions."""


def fewest_substeps(duration: float, longest: float) -> int:
    """As few sub-steps of a duration [s] as keep each within the longest one [s]; at least one."""
    # Rounding must not turn 0.02 s / 0.01 s into three sub-steps.
    return max(1, ceil(duration / longest * (1 - 1e-9)))


@dataclass(frozen=True)
class FrameSteps:
    """Sub-steps between the frames of a clip, or of a window of it.

    Second-order multistep methods need a constant sub-step, so frames that are unevenly spaced get different
    numbers of the same sub-step, and each frame is at the sub-step nearest to its time.

    Attributes:
        ends: number of sub-steps up to each frame (F), 0 first, strictly increasing.
        substeps: per frame where that is the same for all by design; None where the times decide.
    """

    ends: tuple[int, ...]
    substeps: int | None = None

    def __post_init__(self) -> None:
        if not self.ends or self.ends[0] != 0 or any(b <= a for a, b in pairwise(self.ends)):
            raise ValueError(f"ends: expected strictly increasing numbers from 0 on, got {self.ends}")

    @classmethod
    def regular(cls, substeps: int, n_frames: int) -> FrameSteps:
        """The same number of sub-steps for every frame."""
        return cls(tuple(range(0, substeps * n_frames, substeps)), substeps)

    @classmethod
    def nearest(cls, times: Sequence[float], longest: float, largest_error: float) -> FrameSteps:
        """As few sub-steps as bring every frame near its time.

        The last frame is at its time exactly, so that the mean frame rate is kept.

        Args:
            times: of the frames (F), increasing, the first 0, F at least 2 [s].
            longest: sub-step [s].
            largest_error: by which a frame may be off [s]; never more than 5 % of the shortest interval.

        Raises:
            InputError: there would be more than 100 000 sub-steps.
        """
        t = np.asarray(times, dtype=np.float64)
        error = min(largest_error, _SHORTEST_SHARE * float(np.diff(t).min()))
        # With a sub-step of twice the error every time has one within the error, so the search ends.
        fewest = max(len(t) - 1, fewest_substeps(t[-1], longest))
        most = max(fewest, ceil(t[-1] / (2 * error)))
        if most > _MOST:
            raise InputError(
                "Frames are too unevenly spaced to be simulated",
                where="times",
                expected=f"at most {_MOST} sub-steps, or a larger simulator.largest_time_error",
                got=f"{most} of them in {t[-1]:g} s, the shortest interval {np.diff(t).min():g} s",
            )
        for total in range(fewest, most + 1):
            at = t * (total / t[-1])
            ends = np.rint(at)
            if np.abs(ends - at).max() * t[-1] / total <= error and np.diff(ends).min() >= 1:
                break
        return cls(tuple(int(n) for n in ends))

    @property
    def n_frames(self) -> int:
        """F."""
        return len(self.ends)

    @property
    def per_frame(self) -> float:
        """Sub-steps per frame, on average; a clip's mean frame interval divided by it is the sub-step."""
        if self.substeps is not None:
            return self.substeps
        return self.ends[-1] / (self.n_frames - 1)

    def between(self, frame: int) -> int:
        """Number of sub-steps from a frame to the next."""
        return self.ends[frame + 1] - self.ends[frame]

    def intervals(self) -> list[tuple[int, int]]:
        """For every sub-step (frame before it, its number in that interval, from 1 on)."""
        return [(k, sub + 1) for k in range(self.n_frames - 1) for sub in range(self.between(k))]

    def window(self, first: int, last: int) -> FrameSteps:
        """Those of the frames first ... last."""
        start = self.ends[first]
        return FrameSteps(tuple(n - start for n in self.ends[first : last + 1]), self.substeps)

    def at_frames(self, every: Any) -> Any:
        """The frames of an array or tensor of all sub-steps, or of the first of them.

        Args:
            every: (n, ...), of which n - 1 sub-steps end in a frame.
        """
        if self.substeps is not None:
            return every[:: self.substeps]
        return every[[n for n in self.ends if n < len(every)]]

    def times(self, step: float) -> torch.Tensor:
        """When the frames are simulated (F,) [s], for a sub-step [s]."""
        return torch.tensor(self.ends, dtype=torch.float64) * step


_MOST = 100_000
"""Sub-steps of a clip; a minute at 1 ms is 60 000 of them, beyond that a time stamp must be wrong."""
