"""Learning rate and length of the rollouts over a run."""

from __future__ import annotations

from itertools import pairwise

import pytest

from toile.learning.surrogate.schedules import RolloutLength, Stairs, WarmCosine


def test_the_papers_learning_rate() -> None:
    stairs = Stairs(1e-3, 0.2, (25, 50))
    rates = [stairs.at(step, 10, 1000) for step in (0, 249, 250, 499, 500, 999)]
    assert rates == pytest.approx([1e-3, 1e-3, 2e-4, 2e-4, 4e-5, 4e-5])


def test_warm_cosine() -> None:
    rates = [WarmCosine(1e-3, 10, 0.6, 0.01).at(step, 10, 101) for step in range(101)]
    assert rates[0] == pytest.approx(1e-4)
    assert rates[9:60] == pytest.approx([1e-3] * 51)
    assert all(a >= b for a, b in pairwise(rates[9:]))
    assert rates[-1] == pytest.approx(1e-5)


def test_rollouts_grow() -> None:
    length = RolloutLength(20, 400, 0.5)
    assert [length.at(step, 100) for step in (0, 25, 50, 99)] == [20, 210, 400, 400]
