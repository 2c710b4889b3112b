"""Damping grows where a step does not lower the cost, and goes where one does."""

from __future__ import annotations

from toile.diagnosis.damping import Damping


def test_it_grows_and_falls_by_its_settings() -> None:
    damping = Damping(first=8.0, stronger=3.0, weaker=2.0)
    assert damping.more(0.0) == 8.0
    assert damping.more(8.0) == 24.0
    assert damping.less(24.0) == 12.0
    # Below the first one there is none.
    assert damping.less(4.0) == 0.0
