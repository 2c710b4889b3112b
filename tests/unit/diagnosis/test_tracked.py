"""Windows of the tracking before a diagnosis."""

from __future__ import annotations

from toile.diagnosis.tracked import StopAt
from toile.reconstruction.gauss_newton.recipe import SlidingWindows


def test_one_window_ends_at_the_frame() -> None:
    plan = StopAt(SlidingWindows(6, 2, 1), 9).plan(14)
    assert plan == [(0, 2), (0, 4), (0, 6), (2, 8), (3, 9), (4, 10), (6, 12), (7, 13)]


def test_windows_that_end_there_anyway_stay_as_they_are() -> None:
    windows = SlidingWindows(6, 1, 1)
    assert StopAt(windows, 9).plan(14) == windows.plan(14)


def test_a_clip_that_ends_before_the_frame() -> None:
    windows = SlidingWindows(6, 2, 1)
    assert StopAt(windows, 29).plan(14) == windows.plan(14)
