"""Problems and recipes on the swaying cloth."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from toile.physics.implicit.integrators import BDF2
from toile.physics.implicit.newton import NewtonSettings
from toile.physics.implicit.simulator import ImplicitSimulator
from toile.reconstruction.adam import SuccessiveFramesAdam
from toile.reconstruction.losses.force_regularization import ForceRegularization
from toile.reconstruction.losses.image import ImageLoss
from toile.reconstruction.losses.silhouette import SilhouetteLoss
from toile.reconstruction.parameters import ClothParameters
from toile.reconstruction.problem import Reconstruction
from toile.reconstruction.scene_cloth import RestLengths, scene_cloth, scene_units, template
from toile.rendering import WarpRenderer
from toile.scenes.scene import Scene

AREAL_DENSITY = 0.15


@pytest.fixture
def problem(swaying_scene: Scene) -> Callable[..., Reconstruction]:
    """Makes the same problem anew each time: rest lengths, shearing stiffness and scene as asked for."""

    def make(
        rest_lengths: RestLengths = template, shearing: float = 8.0, scene: Scene = swaying_scene
    ) -> Reconstruction:
        cloth = scene_cloth(scene, AREAL_DENSITY, rest_lengths)
        parameters = ClothParameters(
            scene.n_frames,
            cloth.n_vertices,
            len(cloth.pinned),
            scene_units(scene, AREAL_DENSITY),
            stretching=3000.0,
            shearing=shearing,
            bending=0.5,
        )
        return Reconstruction(
            scene,
            cloth,
            lambda cloth, step: ImplicitSimulator(cloth, step, BDF2(), NewtonSettings()),
            2,
            parameters,
            WarpRenderer(),
        )

    return make


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
                "boundary_motion": 1e-3,
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
