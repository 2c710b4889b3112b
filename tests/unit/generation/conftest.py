from __future__ import annotations

import pytest
import torch
from torch import Tensor

from toile.generation.generator import generate
from toile.generation.settings import GeneratorSettings
from toile.generation.textures import procedural_texture
from toile.scenes.scene import Scene

TINY = GeneratorSettings(
    name="tiny",
    grid=(8, 8),
    refinement=2,
    substeps=2,
    n_frames=12,
    fps=25.0,
    cloth_size=(0.5, 0.4),
    stretching=3000.0,
    shearing=40.0,
    bending=1.0,
    initial_wind=(0.0, 0.0, 0.0),
    wind=(0.5, 0.0, 3.0),
    pinned_distance=0.9,
    image_size=(90, 100),
    focal_length=120.0,
    seed=3,
)


@pytest.fixture(scope="session")
def tiny_settings() -> GeneratorSettings:
    return TINY


@pytest.fixture(scope="session")
def tiny_texture() -> Tensor:
    return procedural_texture(64, 64, 0)


@pytest.fixture(scope="session")
def tiny(tiny_texture: Tensor) -> tuple[Scene, dict[str, object]]:
    torch.manual_seed(0)
    return generate(TINY, tiny_texture)
