"""What all tests share: one thread, and a tiny, exactly known scene."""

from __future__ import annotations

import toile.cli  # noqa: F401  # isort: skip  # first, because it sets the number of threads

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image, ImageDraw

from toile.generation.generator import GeneratorSettings, generate
from toile.generation.textures import procedural_texture
from toile.geometry.camera import Camera
from toile.scenes.native import write_native
from toile.scenes.scene import GroundTruth, Scene
from toile.scenes.texture_coordinates import project_coordinates

GRID = (6, 5)
CLOTH_SIZE = (0.5, 0.4)
N_FRAMES = 4


@pytest.fixture
def tiny_scene() -> Scene:
    """A 6×5 cloth hanging 1.2 m in front of an 80×120 px camera, with its true motion."""
    H, W = GRID
    # Axis 0 runs along the held upper edge from left to right, axis 1 downwards; slightly slanted in depth.
    i, j = torch.meshgrid(torch.arange(H), torch.arange(W), indexing="ij")
    template = torch.stack(
        (
            -0.2 + i * CLOTH_SIZE[0] / (H - 1),
            -0.25 + j * CLOTH_SIZE[1] / (W - 1),
            1.2 + 0.002 * i,
        ),
        dim=-1,
    ).to(torch.float64)
    camera = Camera(fx=110.0, fy=105.0, cx=62.5, cy=38.25, height=80, width=120)
    generator = torch.Generator().manual_seed(3)
    frames, masks, motion = [], [], []
    for k in range(N_FRAMES):
        vertices = template + torch.tensor([0.004 * k, 0.0, 0.0])
        motion.append(vertices)
        outline = camera.project(vertices) - 0.5
        image = Image.new("L", (camera.width, camera.height))
        corners = [outline[0, 0], outline[-1, 0], outline[-1, -1], outline[0, -1]]
        ImageDraw.Draw(image).polygon([tuple(c.tolist()) for c in corners], fill=255)
        mask = torch.from_numpy(np.array(image)).to(torch.float32) / 255
        noise = torch.randint(0, 256, (camera.height, camera.width, 3), generator=generator)
        masks.append(mask)
        frames.append(noise.to(torch.float32) / 255)
    return Scene(
        name="tiny",
        frames=torch.stack(frames),
        masks=torch.stack(masks),
        camera=camera,
        texture=frames[0],
        texture_coordinates=project_coordinates(template, camera),
        template=template,
        cloth_size=CLOTH_SIZE,
        gravity=torch.tensor([0.0, 9.81, 0.1], dtype=torch.float64),
        fps=25.0,
        held_vertices=(0, (H - 1) * W),
        original_size=(camera.height, camera.width),
        ground_truth=GroundTruth(
            vertices=torch.stack(motion),
            point_clouds=tuple(v.reshape(-1, 3).to(torch.float32) for v in motion),
        ),
    )


@pytest.fixture
def tiny_folder(tiny_scene: Scene, tmp_path: Path) -> Path:
    return write_native(tiny_scene, tmp_path / "tiny")


@pytest.fixture(scope="session")
def swaying_scene() -> Scene:
    """An 8×8 cloth in the wind, simulated and rendered: 5 frames of 64×64 px that a fit can explain."""
    settings = GeneratorSettings(
        name="swaying",
        grid=(8, 8),
        refinement=1,
        substeps=4,
        n_frames=5,
        image_size=(64, 64),
        focal_length=96.0,
        # Written out, because tolerances of tests were measured on this motion.
        cloth_size=(0.6, 0.6),
        bending=2.0,
        initial_wind=(0.5, 0.0, -1.0),
        wind=(-0.3, 0.0, 1.5),
        held_distance=0.96,
        distance=1.1,
    )
    return generate(settings, procedural_texture(128, 128, seed=0))[0]
