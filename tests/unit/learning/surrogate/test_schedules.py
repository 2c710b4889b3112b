"""Learning rate and length of the rollouts over a run."""

from __future__ import annotations

from itertools import pairwise

import pytest

from toile.learning.surrogate.schedules import (
    RolloutLength,
    Stairs,
    StiffnessShare,
    UnrolledSteps,
    WarmCosine,
)


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


def test_stiff_cloths_come_later() -> None:
    share = StiffnessShare(first=0.5, until=0.4)
    assert [share.at(step, 100) for step in (0, 20, 40, 99)] == pytest.approx([0.5, 0.75, 1.0, 1.0])


def test_more_steps_are_unrolled_in_the_end() -> None:
    unrolled = UnrolledSteps((0.5, 0.9))
    assert [unrolled.at(step, 10) for step in (0, 4, 5, 8, 9)] == [1, 1, 2, 2, 3]
    assert UnrolledSteps(()).at(9, 10) == 1
