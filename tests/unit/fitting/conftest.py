"""Recipes on the swaying cloth."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from toile.fitting.adam.recipe import SuccessiveFramesAdam
from toile.fitting.losses.force_regularization import ForceRegularization
from toile.fitting.losses.image import ImageLoss
from toile.fitting.losses.silhouette import SilhouetteLoss
from toile.fitting.quiet import quiet_lightning


@pytest.fixture(autouse=True)
def _quiet() -> None:
    quiet_lightning()


@pytest.fixture
def adam() -> Callable[..., SuccessiveFramesAdam]:
    """Makes the paper's recipe with few cycles; arguments replace its settings."""

    def make(**changes: Any) -> SuccessiveFramesAdam:
        settings: dict[str, Any] = {
            "losses": {
                "image": ImageLoss(1.0),
                "silhouette": SilhouetteLoss(7.0, 1.0),
                "force_regularization": ForceRegularization(1e-2, 1e-3, 1e-2, "sum"),
            },
            "learning_rates": {
                "stretching": 50.0,
                "shearing": 0.1,
                "bending": 0.01,
                "wind": 0.05,
                "turbulence": 1e-3,
                "anchor_motion": 1e-3,
                "texture_offset": 2e-4,
            },
            "minimum": {"stretching": 10.0, "shearing": 0.01, "bending": 1e-5},
            "cycles": 12,
            "first_frames": 3,
            "cycles_per_frame": 3,
            "frames_per_render": 8,
        }
        return SuccessiveFramesAdam(**{**settings, **changes})

    return make
