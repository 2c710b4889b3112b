"""Settings of ``toile train``: the paper's numbers, and tuples where the code expects them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from hydra import compose, initialize_config_dir

from toile.cli.configuration import CONF, instantiate, register_resolvers
from toile.learning.surrogate.schedules import Stairs, WarmCosine
from toile.learning.surrogate.settings import TrainingSettings


@pytest.fixture(autouse=True)
def _hydra() -> Iterator[None]:
    register_resolvers()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        yield


def training(*overrides: str) -> TrainingSettings:
    settings: Any = instantiate(compose("train", list(overrides)).training)
    assert isinstance(settings, TrainingSettings)
    return settings


def test_the_papers_numbers() -> None:
    """Section 3.1.5."""
    settings = training("training=paper")
    assert (settings.pool.size, settings.batch_size, settings.epochs, settings.n_passes) == (
        5000,
        300,
        100,
        1,
    )
    assert settings.learning_rate == Stairs(1e-3, 0.2, (25, 50))
    assert settings.pool.grid == (32, 32)
    materials = settings.pool.materials
    assert materials.stretching == (10.0, 10000.0)
    assert materials.shearing == (0.01, 10.0)
    assert materials.bending == (0.001, 10.0)
    assert settings.rollout_length is None


@pytest.mark.parametrize("name", ["cpu", "tiny"])
def test_training_on_a_cpu(name) -> None:
    settings = training(f"training={name}")
    assert isinstance(settings.learning_rate, WarmCosine)
    assert settings.rollout_length is not None
    assert settings.pool.materials == training("training=paper").pool.materials


def test_all_numbers_can_be_changed() -> None:
    settings = training("training=cpu", "training.pool.forces.gravity=[0.1,0.2]", "training.widths=[4,8,8]")
    assert settings.pool.forces.gravity == (0.1, 0.2)
    assert settings.widths == (4, 8, 8)
    assert training("training=cpu", "training.rollout_length=null").rollout_length is None
    stairs = training("training=cpu", "training/learning_rate=stairs").learning_rate
    assert stairs == Stairs(1e-3, 0.2, (25, 50))
