"""When the frames of a clip were taken: even spacing, uneven spacing, and what is remarkable about it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from toile.errors import InputError
from toile.scenes.findings import Finding, Severity, named

Times = npt.NDArray[np.float64]
"""Times of the frames (F,) [s]."""

EVEN = 0.01
"""Of the mean interval, by which frames may be off and still count as evenly spaced: containers round time
stamps, and a displacement between two frames that is wrong by 2 % is below what is seen."""

MISSING = 1.5
"""Times the median interval, from which on frames are missing in between: half way from one to two."""

FEW_GAPS = 0.25
"""Share of the intervals up to which long ones are gaps in a regular clip; more are another frame rate."""

FEWEST_FRAMES = 6
"""Below that a warning: a window of the tracking has six frames, and with fewer almost any forces fit."""


@dataclass(frozen=True)
class UniformSubset:
    """Frames of an uneven clip that are evenly spaced.

    Attributes:
        frames: which ones, the first included.
        fps: their rate.
        largest_error: by which one of them is off an even spacing [s].
    """

    frames: tuple[int, ...]
    fps: float
    largest_error: float


def check_times(times: Sequence[float], n_frames: int, fps: float | None, where: str) -> list[Finding]:
    """Errors: not one finite time per frame, increasing from 0 on; a mean rate that is not ``fps``."""
    t = np.asarray(times, dtype=np.float64)
    expected = "one time per frame in seconds, increasing, the first 0"
    if len(t) != n_frames:
        got = f"{len(t)} times for {n_frames} frames"
    elif not np.isfinite(t).all():
        got = f"frame {int((~np.isfinite(t)).argmax())} at {t[~np.isfinite(t)][0]} s"
    elif n_frames and t[0] != 0:
        got = f"the first at {t[0]:g} s"
    elif (np.diff(t) <= 0).any():
        k = int((np.diff(t) <= 0).argmax())
        got = f"frame {k} at {t[k]:g} s, frame {k + 1} at {t[k + 1]:g} s"
    else:
        got = ""
    if got:
        return [Finding(Severity.ERROR, "Times of the frames are wrong", f"{where}: times", expected, got)]
    if fps is not None and n_frames > 1:
        mean = (n_frames - 1) / t[-1]
        if abs(fps / mean - 1) > EVEN:
            expected, got = f"fps {mean:.6g}, the mean rate of the times, or no times", f"fps {fps:g}"
            return [Finding(Severity.ERROR, "Frame rate and times disagree", where, expected, got)]
    return []


def settled(
    times: Sequence[float], fps: float | None = None, rounding: float = 0.0
) -> tuple[tuple[float, ...] | None, float]:
    """Times from the first frame on, or None if evenly spaced, and frames per second.

    Args:
        times: strictly increasing [s], at least one.
        fps: stated rate, kept if the frames are evenly spaced at it.
        rounding: of the time stamps [s]; a tick of the container's clock.

    Returns:
        Times with the first at 0, or None; the stated rate, or else the mean one.
    """
    t = np.asarray(times, dtype=np.float64)
    t = t - t[0]
    if len(t) < 2:
        if fps is None:
            raise ValueError("fps: expected a number for a single frame")
        return None, fps
    mean = (len(t) - 1) / float(t[-1])
    for rate in (fps, mean):
        if rate is not None:
            off = np.abs(t - np.arange(len(t)) / rate).max()
            if off <= max(EVEN / rate, rounding) * (1 + 1e-6):
                return None, rate
    return tuple(t.tolist()), mean


def uniform_subset(times: Sequence[float], tolerance: float) -> UniformSubset:
    """The most frames that are evenly spaced: the largest rate at which every instant has a frame of its own.

    The first frame is among them. Nothing is interpolated.

    Args:
        times: strictly increasing [s].
        tolerance: by which a frame may be off its instant, as a fraction of the interval, below 0.5.

    Raises:
        InputError: there are fewer than two.
    """
    t = np.asarray(times, dtype=np.float64)
    if len(t) < 2:
        raise InputError(
            "No evenly spaced frames can be chosen",
            where="times=uniform",
            expected="at least two frames",
            got=f"{len(t)} frames",
        )
    t = t - t[0]
    # No instant may fall into a gap, so the interval is at least the longest one but for the tolerance. The
    # shortest interval that will do is one at which a frame is just late enough.
    shortest = float(np.diff(t).max()) / (1 + 2 * tolerance) * (1 - 1e-9)
    most = int(t[-1] / shortest) + 1
    late = np.arange(1, most + 1)[:, None] + tolerance
    candidates = np.unique(np.append(t[1:], (t[None, 1:] / late).ravel()))
    for interval in candidates[candidates >= shortest]:
        wanted = interval * np.arange(int(t[-1] / interval + tolerance * (1 + 1e-9)) + 1)
        nearest = _nearest(t, wanted)
        if len(wanted) > 1 and (np.abs(t[nearest] - wanted) <= interval * tolerance * (1 + 1e-9)).all():
            chosen = t[nearest]
            slope, start = np.polyfit(np.arange(len(chosen)), chosen, 1)
            error = np.abs(chosen - start - slope * np.arange(len(chosen))).max()
            return UniformSubset(tuple(nearest.tolist()), 1 / float(slope), float(error))
    raise AssertionError("the first and the last frame are evenly spaced")


def check_spacing(times: Sequence[float] | None, where: str) -> list[Finding]:
    """Warnings: frames that are unevenly spaced, and frames that are missing.

    Args:
        times: of the frames [s]; None where they are evenly spaced.
        where: file or folder, for messages.
    """
    if times is None or len(times) < 3:
        return []
    intervals = np.diff(np.asarray(times, dtype=np.float64))
    median = float(np.median(intervals))
    shortest, longest = 1e3 * intervals.min(), 1e3 * intervals.max()
    findings = [
        Finding(
            Severity.WARNING,
            "Frames are unevenly spaced",
            where,
            "one frame rate, but for rounding",
            f"{shortest:.4g} to {longest:.4g} ms, median {1e3 * median:.4g} ms",
        )
    ]
    gaps = np.flatnonzero(intervals >= MISSING * median)
    if 0 < len(gaps) <= FEW_GAPS * len(intervals):
        lost = int(sum(round(float(intervals[k]) / median) - 1 for k in gaps))
        findings.append(
            Finding(
                Severity.WARNING,
                "Frames are missing",
                f"{where}: after {named(gaps.tolist())}",
                f"intervals below {MISSING:g} times the median of {1e3 * median:.4g} ms",
                f"{len(gaps)} longer ones, up to {longest:.4g} ms; about {lost} frames were dropped",
            )
        )
    return findings


def check_number_of_frames(n_frames: int, where: str) -> list[Finding]:
    """A warning for a clip of fewer frames than tell a motion's forces."""
    if n_frames >= FEWEST_FRAMES:
        return []
    expected = f"at least {FEWEST_FRAMES}, better 30 or more: with fewer, almost any forces explain them"
    return [Finding(Severity.WARNING, "Few frames", where, expected, str(n_frames))]


def _nearest(t: Times, wanted: Times) -> npt.NDArray[np.intp]:
    right = np.clip(np.searchsorted(t, wanted), 1, len(t) - 1)
    return np.where(wanted - t[right - 1] <= t[right] - wanted, right - 1, right)
