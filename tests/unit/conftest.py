"""Problems on the swaying cloth."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from toile.fitting.parameters import ClothParameters
from toile.fitting.reconstruction import Reconstruction
from toile.fitting.scene_cloth import RestLengths, scene_cloth, scene_units, template
from toile.rendering import WarpRenderer
from toile.scenes.scene import Scene
from toile.simulators.implicit.integrators import BDF2
from toile.simulators.implicit.newton import NewtonSettings
from toile.simulators.implicit.simulator import ImplicitSimulator

AREAL_DENSITY = 0.15


@pytest.fixture
def problem(swaying_scene: Scene) -> Callable[..., Reconstruction]:
    """Makes the same problem anew each time, with rest lengths and shearing stiffness as asked for."""

    def make(rest_lengths: RestLengths = template, shearing: float = 8.0) -> Reconstruction:
        cloth = scene_cloth(swaying_scene, AREAL_DENSITY, rest_lengths)
        parameters = ClothParameters(
            swaying_scene.n_frames,
            cloth.n_vertices,
            len(cloth.held),
            scene_units(swaying_scene, AREAL_DENSITY),
            stretching=3000.0,
            shearing=shearing,
            bending=0.5,
        )
        return Reconstruction(
            swaying_scene,
            cloth,
            lambda cloth, step: ImplicitSimulator(cloth, step, BDF2(), NewtonSettings()),
            2,
            parameters,
            WarpRenderer(),
        )

    return make
