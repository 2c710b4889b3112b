"""What every renderer takes and returns.

A renderer is four plain stages: rasterize → interpolate → texture → antialias. The split is the one of
S. Laine et al., "Modular Primitives for High-Performance Differentiable Rendering", ACM TOG 39(6), 2020.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor

from toile.errors import InputError
from toile.geometry.camera import Camera

NEAR = 1e-3
"""Faces with a vertex at z <= NEAR [m] are not drawn; there is no clipping."""


@dataclass(frozen=True)
class RenderedImages:
    """Images of B frames, float32, row 0 on top.

    Attributes:
        rgb: colours (B, h, w, 3), black where there is no cloth.
        silhouette: coverage (B, h, w) in [0, 1], antialiased at the silhouette.
        depth: z of the surface at the pixel centre (B, h, w) [m], 0 where nothing was hit; not antialiased.
    """

    rgb: Tensor
    silhouette: Tensor
    depth: Tensor


@dataclass(frozen=True)
class Fragments:
    """What lies under each pixel centre; carries no gradients.

    Attributes:
        face: index of the nearest face (B, h, w), int64, -1 where nothing was hit.
        barycentrics: perspective-correct barycentric coordinates (B, h, w, 3), float32, 0 where no hit.
        depth: z of the hit (B, h, w) [m], float32, 0 where no hit.
    """

    face: Tensor
    barycentrics: Tensor
    depth: Tensor


class Renderer(ABC):
    """Renders a textured triangle mesh through a pinhole camera, with gradients.

    Conventions shared by all back ends: pixel centres at (c + 0.5, r + 0.5); black background; both sides
    of a face are drawn; the nearest face wins and, at equal depth, the one with the lowest index; bilinear
    texture lookup, clamped at the border; faces with a vertex at z <= NEAR are skipped.
    """

    def render(
        self,
        vertices: Tensor,
        faces: Tensor,
        texture_coordinates: Tensor,
        texture: Tensor,
        camera: Camera,
    ) -> RenderedImages:
        """Render B frames of one mesh.

        Differentiable with respect to ``vertices``, ``texture_coordinates`` and ``texture``.

        Args:
            vertices: positions (B, V, 3) [m], float32 or float64; in the world, which is the camera frame
                (x right, y down, z forward) where the camera has no pose.
            faces: vertex indices (T, 3), int64.
            texture_coordinates: (V, 2), (u, v) in [0, 1], u to the right and v down from the top-left corner.
            texture: colours (h_t, w_t, 3), row 0 on top.
            camera: pinhole camera; sets the image size.

        Raises:
            InputError: an argument has the wrong shape, dtype, device, or an index out of range.
        """
        _check_mesh(vertices, faces, camera)
        n_vertices = vertices.shape[1]
        if texture_coordinates.shape != (n_vertices, 2) or not texture_coordinates.is_floating_point():
            raise _wrong("texture_coordinates", f"floating point ({n_vertices}, 2)", texture_coordinates)
        if (
            texture.ndim != 3
            or texture.shape[2] != 3
            or not texture.numel()
            or not texture.is_floating_point()
        ):
            raise _wrong("texture", "floating point (h_t, w_t, 3)", texture)
        for name, tensor in (("texture_coordinates", texture_coordinates), ("texture", texture)):
            if tensor.device != vertices.device:
                raise _wrong(name, f"a tensor on {vertices.device}, like vertices", tensor)
        seen = camera.from_world(vertices)
        return self._render(seen, faces, texture_coordinates, texture, camera.at_origin())

    def rasterize(self, vertices: Tensor, faces: Tensor, camera: Camera) -> Fragments:
        """Find the nearest face under each pixel centre.

        Args: see ``render``; ``vertices`` (B, V, 3) [m], ``faces`` (T, 3).

        Raises:
            InputError: an argument has the wrong shape, dtype, device, or an index out of range.
        """
        _check_mesh(vertices, faces, camera)
        return self._rasterize(camera.from_world(vertices.detach()), faces, camera.at_origin())

    @abstractmethod
    def _render(
        self, vertices: Tensor, faces: Tensor, texture_coordinates: Tensor, texture: Tensor, camera: Camera
    ) -> RenderedImages:
        """``render`` on checked arguments; vertices in the camera frame."""

    @abstractmethod
    def _rasterize(self, vertices: Tensor, faces: Tensor, camera: Camera) -> Fragments:
        """``rasterize`` on checked arguments; vertices in the camera frame."""


def to_screen(vertices: Tensor, camera: Camera) -> Tensor:
    """Project (B, V, 3) [m], camera frame, to (x [px], y [px], z [m]); differentiable.

    In the precision of the input. A vertex at z <= NEAR gets (0, 0, 0), with zero gradient: the mark by which
    the later stages skip its faces.
    """
    in_front = vertices[..., 2:] > NEAR
    # Replaced before the division, so that neither the value nor the gradient is ever inf or nan.
    safe = torch.where(in_front, vertices, torch.ones_like(vertices))
    screen = torch.cat((camera.project(safe), safe[..., 2:]), dim=-1)
    return torch.where(in_front, screen, torch.zeros_like(screen))


def check_supersampling(factor: int) -> int:
    """Return ``factor`` if it is a whole number of at least 1, else raise InputError."""
    if isinstance(factor, bool) or not isinstance(factor, int) or factor < 1:
        raise InputError(
            "wrong supersampling factor",
            where="supersampling",
            expected="a whole number >= 1",
            got=repr(factor),
        )
    return factor


def downsample(images: RenderedImages, factor: int) -> RenderedImages:
    """Average blocks of factor × factor samples; depth is averaged over the samples that hit something."""
    if factor == 1:
        return images

    def mean(image: Tensor) -> Tensor:
        b, h, w = image.shape[:3]
        return image.reshape(b, h // factor, factor, w // factor, factor, *image.shape[3:]).mean(dim=(2, 4))

    hit = mean((images.depth > 0).float())
    depth = mean(images.depth) / torch.where(hit > 0, hit, torch.ones_like(hit))
    return RenderedImages(mean(images.rgb), mean(images.silhouette), depth)


def _check_mesh(vertices: Tensor, faces: Tensor, camera: Camera) -> None:
    is_batch = vertices.ndim == 3 and vertices.shape[2] == 3 and len(vertices) > 0
    if not is_batch or not vertices.is_floating_point():
        raise _wrong("vertices", "floating point (B, V, 3) in metres, B >= 1", vertices)
    if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype != torch.int64:
        raise _wrong("faces", "int64 (T, 3)", faces)
    if faces.device != vertices.device:
        raise _wrong("faces", f"a tensor on {vertices.device}, like vertices", faces)
    if faces.numel():
        low, high = (int(x) for x in torch.aminmax(faces))
        if low < 0 or high >= vertices.shape[1]:
            raise InputError(
                "vertex index out of range",
                where="faces",
                expected=f"indices in [0, {vertices.shape[1]})",
                got=f"indices from {low} to {high}",
            )
    if camera.height < 1 or camera.width < 1:
        raise InputError(
            "empty image",
            where="camera",
            expected="height and width >= 1",
            got=f"{camera.height} × {camera.width}",
        )


def _wrong(name: str, expected: str, tensor: Tensor) -> InputError:
    return InputError(
        f"{name} cannot be rendered",
        where=name,
        expected=expected,
        got=f"{str(tensor.dtype).removeprefix('torch.')} {tuple(tensor.shape)} on {tensor.device}",
    )
