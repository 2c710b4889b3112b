"""The default renderer: NVIDIA Warp kernels, one source for CPU and CUDA."""

from __future__ import annotations

from typing import final

import torch
from torch import Tensor

from toile.geometry.camera import Camera
from toile.limits import Count
from toile.rendering.base import (
    Fragments,
    RenderedImages,
    Renderer,
    check_supersampling,
    downsample,
    to_screen,
)
from toile.rendering.edges import MeshEdges, mesh_edges
from toile.rendering.warp.antialias import Antialias
from toile.rendering.warp.interpolate import Interpolate
from toile.rendering.warp.rasterize import fragments, rasterize
from toile.rendering.warp.texture import Texture
from toile.warp_runtime import start_warp


@final
class WarpRenderer(Renderer):
    """Renders with Warp kernels and hand-written adjoints.

    On the CPU the kernels run serially and a repeated call is bit-identical. On CUDA the images' interior
    is, too, but sums of gradients are atomic and their last bits vary.

    Args:
        supersampling: samples per pixel and axis; 1 draws at the image's own resolution.

    Raises:
        InputError: ``supersampling`` is not a whole number of at least 1.
    """

    def __init__(self, supersampling: Count = 1) -> None:
        self.supersampling = check_supersampling(supersampling)
        start_warp()
        # The topology of the last mesh, keyed by its content: a fit renders the same faces every time.
        self._faces: Tensor | None = None
        self._topology: tuple[Tensor, MeshEdges] | None = None

    def _render(
        self, vertices: Tensor, faces: Tensor, texture_coordinates: Tensor, texture: Tensor, camera: Camera
    ) -> RenderedImages:
        fine = camera.scaled(self.supersampling)
        faces32, edges = self._indices(faces)
        screen = to_screen(vertices, fine).float().contiguous()
        keys = rasterize(screen.detach(), faces32, fine.height, fine.width)
        uv, depth = Interpolate.apply(screen, texture_coordinates.float().contiguous(), faces32, keys)
        rgb, silhouette = Texture.apply(uv, texture.float().contiguous(), depth.detach())
        rgb, silhouette = Antialias.apply(screen, rgb, silhouette, faces32, edges, keys)
        return downsample(RenderedImages(rgb, silhouette, depth), self.supersampling)

    def _rasterize(self, vertices: Tensor, faces: Tensor, camera: Camera) -> Fragments:
        faces32, _ = self._indices(faces)
        screen = to_screen(vertices, camera).float().contiguous()
        return fragments(screen, faces32, rasterize(screen, faces32, camera.height, camera.width))

    def _indices(self, faces: Tensor) -> tuple[Tensor, MeshEdges]:
        """32-bit faces and edges, as the kernels read them."""
        known = self._faces is not None and self._faces.device == faces.device
        if self._topology is None or not known or not torch.equal(faces, self._faces):  # type: ignore[arg-type]
            edges = mesh_edges(faces)
            edges32 = MeshEdges(edges.vertices.int().contiguous(), edges.opposite.int().contiguous())
            self._topology = faces.int().contiguous(), edges32
            self._faces = faces.clone()
        return self._topology
