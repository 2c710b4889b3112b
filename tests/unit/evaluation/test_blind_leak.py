"""The leak test finds what is there and nothing else."""

from __future__ import annotations

import numpy as np
import pytest

from toile.errors import InputError
from toile.evaluation.blind_leak import leak

CLASSES = ["none"] * 15 + ["effect"] * 45


def test_no_leak_in_noise() -> None:
    statistics = np.random.default_rng(3).standard_normal((60, 8))
    found = leak("effect or none", statistics, CLASSES, permutations=100)
    assert found.chance_low <= found.accuracy <= found.chance_high
    assert found.p_value > 0.025
    assert abs(0.5 * (found.chance_low + found.chance_high) - 0.5) < 0.1


def test_leak_is_found() -> None:
    statistics = np.random.default_rng(3).standard_normal((60, 8))
    statistics[15:, 2] += 3.0
    found = leak("effect or none", statistics, CLASSES, permutations=100)
    assert found.accuracy > 0.85 > found.chance_high
    assert found.p_value < 0.02


def test_constant_statistics_are_chance() -> None:
    found = leak("effect or none", np.ones((60, 3)), CLASSES, permutations=20)
    assert found.accuracy == 0.5


def test_too_few_scenes() -> None:
    with pytest.raises(InputError, match="few"):
        leak("effect or none", np.ones((6, 3)), ["none"] + ["effect"] * 5)
