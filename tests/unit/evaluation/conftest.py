"""Small analytic cloths and a renderer that needs no rasteriser."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from toile.geometry.camera import Camera
from toile.rendering.base import Fragments, RenderedImages, Renderer
from toile.scenes.scene import GroundTruth, Scene


def flat_cloth(height: int = 8, width: int = 8, size: float = 0.4, z: float = 1.0) -> Tensor:
    """Flat square grid (H, W, 3) [m] centred on the optical axis at depth z, float64."""
    y, x = torch.meshgrid(
        torch.linspace(-size / 2, size / 2, height, dtype=torch.float64),
        torch.linspace(-size / 2, size / 2, width, dtype=torch.float64),
        indexing="ij",
    )
    return torch.stack((x, y, torch.full_like(x, z)), -1)


class BoxRenderer(Renderer):
    """Fills the bounding box of the projected vertices with their mean depth."""

    def _render(
        self, vertices: Tensor, faces: Tensor, texture_coordinates: Tensor, texture: Tensor, camera: Camera
    ) -> RenderedImages:
        b = vertices.shape[0]
        silhouette = torch.zeros(b, camera.height, camera.width)
        depth = torch.zeros(b, camera.height, camera.width)
        for f, v in enumerate(vertices):
            low, high = camera.project(v).aminmax(dim=0)
            left, top = low.round().int().tolist()
            right, bottom = high.round().int().tolist()
            silhouette[f, top:bottom, left:right] = 1.0
            depth[f, top:bottom, left:right] = v[:, 2].mean()
        return RenderedImages(silhouette[..., None].expand(-1, -1, -1, 3), silhouette, depth)

    def _rasterize(self, vertices: Tensor, faces: Tensor, camera: Camera) -> Fragments:
        raise NotImplementedError


@pytest.fixture
def box_renderer() -> BoxRenderer:
    return BoxRenderer()


@pytest.fixture
def make_scene() -> Callable[..., Scene]:
    def make(
        n_frames: int = 3,
        vertices: Tensor | None = None,
        point_clouds: tuple[Tensor, ...] | None = None,
    ) -> Scene:
        """A flat cloth at 1 m in a 64×64 image with f = 100 px: it covers the middle 40×40 px."""
        template = flat_cloth()
        masks = torch.zeros(n_frames, 64, 64)
        masks[:, 12:52, 12:52] = 1.0
        grid = torch.linspace(0, 1, 8)
        v, u = torch.meshgrid(grid, grid, indexing="ij")
        truth = None
        if vertices is not None or point_clouds is not None:
            truth = GroundTruth(vertices=vertices, point_clouds=point_clouds)
        return Scene(
            name="flat",
            frames=torch.zeros(n_frames, 64, 64, 3),
            masks=masks,
            camera=Camera(100.0, 100.0, 32.0, 32.0, 64, 64),
            texture=torch.rand(16, 16, 3, generator=torch.Generator().manual_seed(0)),
            texture_coordinates=torch.stack((u, v), -1),
            template=template,
            cloth_size=(0.4, 0.4),
            gravity=torch.tensor([0.0, 9.81, 0.0], dtype=torch.float64),
            fps=50.0,
            pinned_vertices=(0, 7),
            ground_truth=truth,
        )

    return make
