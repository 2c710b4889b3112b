"""Optional back end: the nvdiffrast package of Laine et al. 2020, on a CUDA GPU."""

from __future__ import annotations

import importlib
from typing import Any, final

import torch
from torch import Tensor

from toile.errors import InputError
from toile.geometry.camera import Camera
from toile.limits import Count
from toile.rendering.base import (
    NEAR,
    Fragments,
    RenderedImages,
    Renderer,
    check_supersampling,
    downsample,
)

_TILE = 8
"""The CUDA rasterizer draws images whose sides are multiples of this [px]; ours are padded and cut."""


@final
class NvdiffrastRenderer(Renderer):
    """Renders with nvdiffrast; inputs have to be on a CUDA device.

    Which of two faces at equal depth wins is nvdiffrast's choice.

    Args:
        supersampling: samples per pixel and axis; 1 draws at the image's own resolution.

    Raises:
        InputError: nvdiffrast is not installed, there is no CUDA device, or ``supersampling`` is not a whole
            number of at least 1.
    """

    def __init__(self, supersampling: Count = 1) -> None:
        self.supersampling = check_supersampling(supersampling)
        try:
            self._dr: Any = importlib.import_module("nvdiffrast.torch")
        except ImportError as error:
            raise InputError(
                "the nvdiffrast renderer needs a package that is not installed",
                where="renderer=nvdiffrast",
                expected="an installed nvdiffrast, or renderer=warp, which needs nothing more",
                got=str(error),
            ) from error
        if not torch.cuda.is_available():
            raise InputError(
                "the nvdiffrast renderer needs a CUDA GPU",
                where="renderer=nvdiffrast",
                expected="a CUDA device, or renderer=warp, which also runs on the CPU",
                got="torch finds no CUDA device",
            )
        self._context: Any = self._dr.RasterizeCudaContext()

    def _render(
        self, vertices: Tensor, faces: Tensor, texture_coordinates: Tensor, texture: Tensor, camera: Camera
    ) -> RenderedImages:
        dr = self._dr
        fine = camera.scaled(self.supersampling)
        parts = []
        for part, kept in _drawable(vertices, faces):
            drawn = faces[kept].int().contiguous()
            clip = _to_clip(part, fine)
            rast, _ = dr.rasterize(self._context, clip, drawn, resolution=_padded(fine))
            shared = texture_coordinates.float().expand(len(part), -1, -1)
            attributes = torch.cat((shared, part[..., 2:].float()), dim=-1).contiguous()
            interpolated, _ = dr.interpolate(attributes, rast, drawn)
            uv = interpolated[..., :2].contiguous()
            rgb = dr.texture(
                texture.float()[None].contiguous(), uv, filter_mode="linear", boundary_mode="clamp"
            )
            hit = (rast[..., 3:] > 0).float()
            image = torch.cat((rgb * hit, hit), dim=-1).contiguous()
            image = dr.antialias(image, rast, clip, drawn)
            layers = torch.cat((image, interpolated[..., 2:] * hit), dim=-1)
            parts.append(layers[:, : fine.height, : fine.width])
        layers = torch.cat(parts)
        return downsample(RenderedImages(layers[..., :3], layers[..., 3], layers[..., 4]), self.supersampling)

    def _rasterize(self, vertices: Tensor, faces: Tensor, camera: Camera) -> Fragments:
        face_parts, weight_parts, depth_parts = [], [], []
        for part, kept in _drawable(vertices, faces):
            drawn = faces[kept].int().contiguous()
            rast, _ = self._dr.rasterize(
                self._context, _to_clip(part, camera), drawn, resolution=_padded(camera)
            )
            rast = rast[:, : camera.height, : camera.width]
            index = rast[..., 3].long() - 1
            hit = index >= 0
            numbers = kept.nonzero()[:, 0]
            face = torch.where(hit, numbers[index.clamp(min=0)], -1) if len(numbers) else index
            u, v = rast[..., 0], rast[..., 1]
            weights = torch.stack((u, v, 1 - u - v), dim=-1) * hit[..., None]
            frame = torch.arange(len(part), device=part.device)[:, None, None, None]
            z = part[..., 2].float()[frame, faces[face.clamp(min=0)]]
            face_parts.append(face)
            weight_parts.append(weights)
            depth_parts.append((weights * z).sum(-1))
        return Fragments(torch.cat(face_parts), torch.cat(weight_parts), torch.cat(depth_parts))


def _drawable(vertices: Tensor, faces: Tensor) -> list[tuple[Tensor, Tensor]]:
    """Split into batches that share the faces (T,), bool, to draw: one, if no vertex is behind the camera."""
    in_front = (vertices.detach()[..., 2] > NEAR)[:, faces].all(-1)  # (B, T)
    if bool(in_front.all()):
        return [(vertices, in_front[0])]
    return [(vertices[b : b + 1], in_front[b]) for b in range(len(vertices))]


def _padded(camera: Camera) -> list[int]:
    return [-(-camera.height // _TILE) * _TILE, -(-camera.width // _TILE) * _TILE]


def _to_clip(vertices: Tensor, camera: Camera) -> Tensor:
    """Clip coordinates (B, V, 4), float32, of the padded image; row 0 is at y = -1, as nvdiffrast has it."""
    height, width = _padded(camera)
    x, y, z = vertices.unbind(-1)
    depths = z.detach()[z.detach() > NEAR]
    if depths.numel() == 0:
        depths = z.new_ones(1)
    # A tight depth range keeps the precision of the depth test.
    near, far = 0.9 * depths.min(), 1.1 * depths.max()
    clip_x = 2 * (camera.fx * x + camera.cx * z) / width - z
    clip_y = 2 * (camera.fy * y + camera.cy * z) / height - z
    clip_z = (z * (far + near) - 2 * far * near) / (far - near)
    return torch.stack((clip_x, clip_y, clip_z, z), dim=-1).float().contiguous()
