"""Denormal numbers count as zero where they are asked to, and nowhere else."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from toile.denormals import denormals_flushed, flushing
from toile.workers import Workers

TINY = np.full((4, 4), 1e-20, np.float32)


def product() -> float:
    return float((TINY @ TINY).max())


def test_only_inside_and_also_after_an_error() -> None:
    if not torch.set_flush_denormal(False):
        pytest.skip("this processor cannot flush denormal numbers")
    assert 0 < product() < 1e-38
    with denormals_flushed():
        assert product() == 0
    assert product() > 0
    with pytest.raises(FloatingPointError), denormals_flushed():
        raise FloatingPointError
    assert product() > 0


def test_numbers_that_are_no_denormals_stay_as_they_were() -> None:
    some = np.random.default_rng(0).normal(size=(40, 30)).astype(np.float32)
    before = some @ some.T
    with denormals_flushed():
        np.testing.assert_array_equal(some @ some.T, before)


def test_what_is_inside_does_not_end_what_is_around() -> None:
    if not torch.set_flush_denormal(False):
        pytest.skip("this processor cannot flush denormal numbers")
    with denormals_flushed():
        with denormals_flushed():
            assert flushing()
        assert flushing()
        assert product() == 0
    assert not flushing()


def _flushes(item: int) -> bool:
    return flushing()


def test_workers_do_as_the_one_who_asks() -> None:
    if not torch.set_flush_denormal(False):
        pytest.skip("this processor cannot flush denormal numbers")
    with Workers(2) as workers:
        assert list(workers.map(_flushes, [0, 1])) == [False, False]
        with denormals_flushed():
            assert list(workers.map(_flushes, [0, 1])) == [True, True]
        assert list(workers.map(_flushes, [0, 1])) == [False, False]
