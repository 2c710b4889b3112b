"""Denormal numbers count as zero where they are asked to, and nowhere else."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from toile.diagnosis.denormals import denormals_flushed

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
