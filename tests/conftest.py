"""What all tests share: one thread, and a tiny, exactly known scene."""

from __future__ import annotations

import toile.cli  # noqa: F401  # isort: skip  # first, because it sets the number of threads

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image, ImageDraw
from scipy.spatial import Delaunay

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
    # Axis 0 runs along the pinned upper edge from left to right, axis 1 downwards; slightly slanted in depth.
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
        pinned_vertices=(0, (H - 1) * W),
        original_size=(camera.height, camera.width),
        ground_truth=GroundTruth(
            vertices=torch.stack(motion),
            point_clouds=tuple(v.reshape(-1, 3).to(torch.float32) for v in motion),
        ),
    )


@pytest.fixture
def tiny_folder(tiny_scene: Scene, tmp_path: Path) -> Path:
    return write_native(tiny_scene, tmp_path / "tiny")


@dataclass(frozen=True)
class CurvedSheet:
    """A rectangle of 0.5 m × 0.4 m bent around an upright cylinder: developable, so its grid is unique."""

    camera: Camera
    cloth_size: tuple[float, float] = (0.5, 0.4)

    def at(self, s: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Positions (n, 3) [m] at fractions (n,) of the upper side and of the sides, from the upper left."""
        angle = (s - 0.5) * self.cloth_size[0] / 0.35
        x, depth = 0.35 * np.sin(angle), 0.35 * (1 - np.cos(angle))
        y = (t - 0.5) * self.cloth_size[1]
        return np.column_stack((0.04 + x, 0.98 * y - 0.199 * depth - 0.02, 1.1 + 0.98 * depth + 0.199 * y))

    def grid(self, height: int, width: int) -> np.ndarray:
        """The grid (H, W, 3) [m] with equal edges."""
        s, t = np.meshgrid(np.linspace(0, 1, height), np.linspace(0, 1, width), indexing="ij")
        return self.at(s.ravel(), t.ravel()).reshape(height, width, 3)

    def write_video(self, folder: Path, n_frames: int = 2) -> Path:
        """Frames of noise, masks and video.json."""
        size = (self.camera.width, self.camera.height)
        # Drawn four times as large, because a drawn polygon takes half a pixel more on every side.
        pixels = 4 * self.camera.project(torch.from_numpy(self.grid(40, 40))) - 0.5
        image = Image.new("L", (4 * size[0], 4 * size[1]))
        for i, j in np.ndindex(39, 39):
            cell = pixels[[i, i + 1, i + 1, i], [j, j, j + 1, j + 1]]
            ImageDraw.Draw(image).polygon([tuple(p.tolist()) for p in cell], fill=255)
        mask = image.resize(size, Image.Resampling.BOX).point(lambda level: 255 * (level > 127))
        noise = np.random.default_rng(0)
        for name in ("rgbs", "masks"):
            (folder / name).mkdir(parents=True)
        for k in range(n_frames):
            frame = noise.integers(0, 256, (*size[::-1], 3), dtype=np.uint8)
            Image.fromarray(frame).save(folder / "rgbs" / f"rgb_{k:03d}.png")
            mask.save(folder / "masks" / f"mask_{k:03d}.png")
        video = {"fps": 30.0, "width": size[0], "height": size[1]}
        (folder / "video.json").write_text(json.dumps(video))
        return folder

    def irregular_mesh(self, n: int = 1200) -> tuple[np.ndarray, np.ndarray]:
        """Vertices (V, 3) and triangles of random points, nothing of a grid."""
        s = np.linspace(0, 1, 41)[:-1]
        zero, one = np.zeros_like(s), np.ones_like(s)
        border = [(s, zero), (one, s), (1 - s, one), (zero, 1 - s)]
        inner = np.random.default_rng(1).uniform(0.01, 0.99, (n, 2))
        q = np.concatenate([np.column_stack(side) for side in border] + [inner])
        return self.at(*q.T), Delaunay(q).simplices

    def noisy_points(self, n: int = 8000, noise: float = 0.001) -> np.ndarray:
        """Points (N, 3) with Gaussian noise [m], a wall behind and a few strays."""
        random = np.random.default_rng(2)
        cloth = self.at(*random.uniform(size=(2, n))) + noise * random.standard_normal((n, 3))
        wall = np.column_stack((random.uniform(-1, 1, (n // 4, 2)), np.full(n // 4, 2.0)))
        strays = cloth[:20] - np.array([0, 0, 0.2])
        return np.concatenate((cloth, wall, strays))


@pytest.fixture
def curved_sheet() -> CurvedSheet:
    return CurvedSheet(Camera(fx=420.0, fy=410.0, cx=163.0, cy=117.5, height=240, width=320))


def _swaying(pixels: int) -> Scene:
    settings = GeneratorSettings(
        name="swaying",
        grid=(8, 8),
        refinement=1,
        substeps=4,
        n_frames=5,
        image_size=(pixels, pixels),
        focal_length=1.5 * pixels,
        # Written out, because tolerances of tests were measured on this motion.
        cloth_size=(0.6, 0.6),
        bending=2.0,
        initial_wind=(0.5, 0.0, -1.0),
        wind=(-0.3, 0.0, 1.5),
        pinned_distance=0.96,
        distance=1.1,
    )
    return generate(settings, procedural_texture(2 * pixels, 2 * pixels, seed=0))[0]


@pytest.fixture(scope="session")
def swaying_scene() -> Scene:
    """An 8×8 cloth in the wind, simulated and rendered: 5 frames of 64×64 px that a fit can explain."""
    return _swaying(64)


@pytest.fixture(scope="session")
def sharp_swaying_scene() -> Scene:
    """The same in frames of 192×192 px, in which its print is seen."""
    return _swaying(192)
