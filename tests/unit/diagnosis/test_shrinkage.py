"""Intervals of a held-out shrink."""

from __future__ import annotations

import numpy as np

from toile.diagnosis.shrinkage import PredictionSettings, interval


def test_frames_that_share_their_error_widen_the_interval() -> None:
    base = np.full(8, 2.0)
    better = np.array([1.0, 1.0, 1.0, 1.0, 2.0, 2.0, 2.0, 2.0])
    widths = {}
    for block in (1, 4):
        low, high = interval(base, better, 0, PredictionSettings(block=block, resamplings=2000))
        assert low < 0.25 < high
        widths[block] = high - low
    assert widths[4] > 1.3 * widths[1]
    # So few resamplings are one draw.
    low, high = interval(base, better, 0, PredictionSettings(resamplings=1))
    assert low == high


def test_few_frames_have_an_interval() -> None:
    """Blocks may start at any frame: three frames in blocks of two are more than one draw."""
    base, better = np.full(3, 2.0), np.array([0.5, 1.0, 1.5])
    low, high = interval(base, better, 0, PredictionSettings())
    assert low < 0.5 < high
    assert (low, high) == interval(base, better, 0, PredictionSettings())
