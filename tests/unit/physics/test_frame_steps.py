"""Sub-steps between unevenly spaced frames."""

from __future__ import annotations

import numpy as np
import pytest

from toile.errors import InputError
from toile.physics.frame_steps import FrameSteps, fewest_substeps

PHONE = [*(0.02 * k for k in range(8)), *(0.16 + 0.08 * k for k in range(8))]
"""8 frames at 20 ms and 8 at 80 ms."""


def off(steps: FrameSteps, times: list[float]) -> float:
    step = times[-1] / steps.ends[-1]
    return float(np.abs(steps.times(step).numpy() - times).max())


@pytest.mark.parametrize(
    ("duration", "longest", "n"),
    [(0.02, 0.01, 2), (0.03, 0.01, 3), (1 / 30, 0.01, 4), (0.005, 0.01, 1), (600.0, 0.01, 60_000)],
)
def test_as_few_as_keep_a_step_within_the_longest(duration: float, longest: float, n: int) -> None:
    """Whatever rounding does: 0.03 / 0.01 is more than 3."""
    assert fewest_substeps(duration, longest) == n


def test_times_that_have_a_common_step() -> None:
    steps = FrameSteps.nearest(PHONE, longest=0.01, largest_error=1e-3)
    assert np.diff(steps.ends).tolist() == [2] * 8 + [8] * 7
    assert off(steps, PHONE) < 1e-12
    assert steps.per_frame == pytest.approx(72 / 15)


@pytest.mark.parametrize("largest_error", [1e-3, 2e-4])
def test_times_that_have_none(largest_error: float) -> None:
    jitter = np.random.default_rng(0).uniform(-0.004, 0.004, 40)
    times = (np.arange(40) / 30 + np.where(np.arange(40) % 39 > 0, jitter, 0)).tolist()
    steps = FrameSteps.nearest(times, longest=0.01, largest_error=largest_error)
    assert off(steps, times) <= largest_error
    # No finer than the error asks for.
    assert times[-1] / steps.ends[-1] > largest_error


def test_no_frame_is_further_off_than_a_twentieth_of_the_shortest_interval() -> None:
    times = [0.0, 0.0037, 0.1, 0.2]
    assert off(FrameSteps.nearest(times, 0.05, 1.0), times) <= 0.05 * 0.0037


def test_regular_ones_are_what_they_were() -> None:
    steps = FrameSteps.regular(3, 4)
    assert (steps.ends, steps.per_frame, steps.n_frames) == ((0, 3, 6, 9), 3, 4)
    assert steps.intervals() == [(k, s) for k in range(3) for s in (1, 2, 3)]
    every = np.arange(10)
    # A view, as it always was: a copy would add up in another order.
    assert np.shares_memory(steps.at_frames(every), every)
    assert steps.at_frames(every).tolist() == [0, 3, 6, 9]


def test_windows_and_frames_of_uneven_ones() -> None:
    steps = FrameSteps((0, 1, 2, 6, 8))
    assert steps.window(2, 4).ends == (0, 4, 6)
    assert steps.at_frames(np.arange(7)).tolist() == [0, 1, 2, 6]
    assert steps.window(1, 3).intervals() == [(0, 1), (1, 1), (1, 2), (1, 3), (1, 4)]


@pytest.mark.parametrize("ends", [(), (1, 2), (0, 2, 2), (0, 3, 1)])
def test_frames_in_no_order(ends: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="strictly increasing"):
        FrameSteps(ends)


def test_a_time_stamp_that_must_be_wrong() -> None:
    with pytest.raises(InputError, match="unevenly spaced"):
        FrameSteps.nearest([0.0, 1e-6, 1.0], 0.01, 1e-3)
