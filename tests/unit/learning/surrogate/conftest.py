"""A training that takes seconds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch

from toile.learning.surrogate.forces import ForceSampler
from toile.learning.surrogate.materials import MaterialRanges
from toile.learning.surrogate.module import SurrogateTraining
from toile.learning.surrogate.pinned_corners import PinnedCornerSampler
from toile.learning.surrogate.pool import Pool, PoolSettings
from toile.learning.surrogate.resets import ResetRules
from toile.learning.surrogate.rest_shapes import RestShapeSampler
from toile.learning.surrogate.schedules import RolloutLength, WarmCosine
from toile.learning.surrogate.settings import TrainingSettings
from toile.learning.surrogate.validation import ValidationSettings
from toile.physics.surrogate.surrogate import Surrogate

POOL = PoolSettings(
    size=8,
    grid=(6, 7),
    materials=MaterialRanges((10.0, 1e4), (0.01, 10.0), (0.001, 10.0)),
    rest_shapes=RestShapeSampler(0.04),
    forces=ForceSampler((0.001, 0.7), 0.7, 1.0, 4, 0.95),
    pinned_corners=PinnedCornerSampler((0.05, 0.1, 0.75, 0.1), 0.3, 0.3, 0.97),
    bdf2_share=0.5,
    noise=0.01,
    noise_share=0.5,
)
TRAINING = TrainingSettings(
    widths=(4, 8),
    epochs=3,
    steps_per_epoch=3,
    batch_size=4,
    n_passes=2,
    learning_rate=WarmCosine(1e-3, 2, 0.6, 0.01),
    adam_betas=(0.9, 0.99),
    gradient_norm=1.0,
    average_decay=0.99,
    rollout_length=RolloutLength(2, 6, 0.5),
    pool=POOL,
    resets=ResetRules(20.0, 0.002, 200.0, 0.05),
    validation=ValidationSettings(size=3, steps=2, n_passes=1, seed=1),
)


@pytest.fixture(autouse=True, scope="session")
def _one_thread() -> None:
    torch.set_num_threads(1)


@pytest.fixture
def make_pool() -> Callable[..., Pool]:
    """A pool, with some settings changed."""

    def make(seed: int = 0, **changes: Any) -> Pool:
        return Pool(replace(POOL, **changes), torch.Generator().manual_seed(seed))

    return make


@pytest.fixture
def make_training() -> Callable[..., SurrogateTraining]:
    """A training, with some settings changed."""

    def make(seed: int = 0, **changes: Any) -> SurrogateTraining:
        settings = replace(TRAINING, **changes)
        torch.manual_seed(seed)
        return SurrogateTraining(Surrogate(settings.widths), settings)

    return make
