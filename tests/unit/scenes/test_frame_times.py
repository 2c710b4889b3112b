"""Even and uneven spacing of frames."""

from __future__ import annotations

import numpy as np
import pytest

from toile.errors import InputError
from toile.scenes.frame_times import (
    check_number_of_frames,
    check_spacing,
    check_times,
    settled,
    uniform_subset,
)


def test_even_times_are_a_rate() -> None:
    assert settled(np.arange(9) / 30 + 5, 30.0) == (None, 30.0)
    # A stated rate that they do not have gives way to the one they have.
    times, fps = settled(np.arange(9) / 30, 25.0)
    assert (times, fps) == (None, pytest.approx(30))
    # Off by more than rounding, and by less than the rounding of the container.
    off = np.arange(9) / 30 + np.where(np.arange(9) == 4, 8e-4, 0)
    times, fps = settled(off + 2, 30.0)
    assert times is not None
    np.testing.assert_allclose(times, off, atol=1e-12)
    assert fps == pytest.approx(30)
    assert settled(off, 30.0, rounding=1e-3) == (None, 30.0)


def test_a_slow_drift_is_not_even() -> None:
    """Every interval is within 1 % of the mean; after 40 frames the clip is half a frame off."""
    times, _ = settled(np.cumsum(np.linspace(0.98, 1.02, 60)) / 30)
    assert times is not None


@pytest.mark.parametrize(
    ("times", "got"),
    [
        ([0.0, 0.1], "2 times for 3 frames"),
        ([0.0, 0.2, 0.1], "frame 1 at 0.2 s, frame 2 at 0.1 s"),
        ([0.0, 0.1, 0.1], "frame 1 at 0.1 s"),
        ([0.1, 0.2, 0.3], "the first at 0.1 s"),
        ([0.0, float("nan"), 0.3], "frame 1 at nan s"),
        ([0.0, 0.1, 0.4], "fps 25"),
    ],
)
def test_wrong_times(times: list[float], got: str) -> None:
    (finding,) = check_times(times, 3, 25.0, "here")
    assert finding.severity == "error"
    assert got in finding.got


def test_sound_times() -> None:
    assert check_times([0.0, 0.1, 0.4], 3, 5.0, "here") == []
    assert check_times([0.0, 0.1, 0.4], 3, None, "here") == []


def test_uniform_subset_is_the_largest_rate() -> None:
    random = np.random.default_rng(2)
    even = np.arange(20) / 30 + np.where(np.arange(20) > 0, random.uniform(-1e-3, 1e-3, 20), 0)
    extra = even[:-1] + np.diff(even) * 0.4
    times = np.sort(np.concatenate((even, extra[::3])))
    subset = uniform_subset(times, 0.05)
    np.testing.assert_allclose(times[list(subset.frames)], even)
    assert subset.fps == pytest.approx(30, rel=2e-3)
    assert subset.largest_error < 1.5e-3
    # A frame that is missing halves the rate: no picture is invented.
    assert uniform_subset(np.delete(even, 7), 0.05).fps == pytest.approx(15, rel=2e-3)


def test_no_subset() -> None:
    with pytest.raises(InputError, match="No evenly spaced"):
        uniform_subset([0.0], 0.1)


def test_spacing_warnings() -> None:
    assert check_spacing(None, "here") == []
    jitter = [0.0, 0.03, 0.07, 0.1, 0.14, 0.17]
    assert [f.what for f in check_spacing(jitter, "here")] == ["Frames are unevenly spaced"]


def test_few_frames() -> None:
    assert check_number_of_frames(6, "here") == []
    (finding,) = check_number_of_frames(5, "here")
    assert (finding.what, finding.got) == ("Few frames", "5")
