"""Filming a simulated motion: camera, light, exposure, noise, mask, and what effects do to them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.ndimage import gaussian_filter
from torch import Tensor

from toile.generation.out_of_family.interface import Array, OutOfFamilyEffect
from toile.generation.out_of_family.optics import RaggedMask
from toile.geometry.camera import Camera
from toile.geometry.mesh import grid_faces, vertex_normals
from toile.rendering.warp import WarpRenderer

_MARGIN = 0.12
"""Space around the clip without effects, as a fraction of the longer side of its box."""


@dataclass(frozen=True)
class Print:
    """What is printed on the cloth.

    Attributes:
        texture: (h_t, w_t, 3).
        coordinates: (H', W', 2) of the simulated grid.
    """

    texture: Tensor
    coordinates: Tensor


@dataclass(frozen=True)
class FilmSettings:
    """Of the camera and its sensor.

    Attributes:
        supersampling: samples per pixel and axis.
        blur_samples: renders per motion-blurred frame.
        blur: of the lens [px].
        noise: of the sensor, in [0, 1].
        seed: of the noise.
    """

    supersampling: int
    blur_samples: int
    blur: float
    noise: float
    seed: int


def framed_camera(full: Camera, motion: Tensor, side: int, scale: float | None = None) -> Camera:
    """The camera scaled and cropped to a motion (F, H, W, 3) [m].

    Args:
        full: of the whole image.
        motion: in view, with a margin.
        side: longer side of the image [px].
        scale: of the camera instead of that which ``side`` asks for.
    """
    pixels = full.project(motion).reshape(-1, 2)
    low, high = pixels.amin(0), pixels.amax(0)
    margin = _MARGIN * float((high - low).max())
    low, high = low - margin, high + margin
    scale = side / float((high - low).max()) if scale is None else scale
    left, top = (round(float(x) * scale) for x in low)
    width, height = (round(float(x) * scale) for x in high - low)
    scaled = full.scaled(scale)
    return scaled.crop(top, left, height, width)


def film(
    settings: FilmSettings,
    camera: Camera,
    printed: Print,
    motion: Tensor,
    substeps: int,
    effects: Sequence[OutOfFamilyEffect],
) -> tuple[Tensor, Tensor]:
    """Frames (F, h, w, 3) and masks (F, h, w), rounded to 8 bits, of a motion with its sub-steps."""
    H, W = motion.shape[1:3]
    faces = grid_faces(H, W)
    renderer = WarpRenderer(settings.supersampling)
    rng = np.random.default_rng([settings.seed, 1])
    exposure = max((e.exposure() for e in effects), default=0.0)
    shaders = [e for e in effects if type(e).brightness is not OutOfFamilyEffect.brightness]
    widths = camera.project(motion[0])
    width_px = float((widths[-1] - widths[0]).norm(dim=-1).mean())
    for effect in effects:
        if isinstance(effect, RaggedMask):
            effect.pixels_per_percent = 0.01 * width_px
    normal_scale = [_mean_brightness(e, motion[0], faces) for e in shaders]
    # Values per vertex as an image with one pixel for each, so that the renderer interpolates them.
    u, v = ((torch.arange(n, dtype=torch.float32) + 0.5) / n for n in (H, W))
    own_places = torch.stack(torch.meshgrid(u, v, indexing="ij"), -1).reshape(-1, 2)
    frames, masks = [], []
    n_frames = (len(motion) - 1) // substeps + 1
    for frame in range(n_frames):
        rgb_sum, coverage_sum = None, None
        moments = _moments(frame, substeps, len(motion), exposure, settings.blur_samples)
        rendered: dict[float, tuple[Array, Array]] = {}
        for index in moments:
            if index not in rendered:
                before, after = motion[math.floor(index)], motion[math.ceil(index)]
                positions = torch.lerp(before, after, index % 1.0).reshape(-1, 3)
                seen = _seen(positions, camera, effects)[None]
                images = renderer.render(
                    seen, faces, printed.coordinates.reshape(-1, 2), printed.texture, camera
                )
                rgb, coverage = images.rgb[0].numpy(), images.silhouette[0].numpy()
                for shader, scale in zip(shaders, normal_scale, strict=True):
                    factor = shader.brightness(_facing_normals(positions, faces))
                    assert factor is not None
                    image = (factor / scale).float().reshape(H, W).T[..., None].expand(W, H, 3)
                    shade = (
                        renderer.render(seen, faces, own_places, image.contiguous(), camera).rgb[0].numpy()
                    )
                    rgb = rgb * shade / np.maximum(coverage, 0.05)[..., None]
                rendered[index] = rgb, coverage
            rgb, coverage = rendered[index]
            rgb_sum = rgb if rgb_sum is None else rgb_sum + rgb
            coverage_sum = coverage if coverage_sum is None else coverage_sum + coverage
        assert rgb_sum is not None
        assert coverage_sum is not None
        image_np = gaussian_filter(rgb_sum / len(moments), (settings.blur, settings.blur, 0))
        cover_np = gaussian_filter(coverage_sum / len(moments), settings.blur)
        mask = (cover_np > 0.5).astype(np.float64)
        for effect in effects:
            image_np = effect.cover(image_np, mask, frame)
        noise = settings.noise * rng.standard_normal(image_np.shape)
        for effect in effects:
            mask = effect.mask(mask, frame)
        image_np = (image_np + noise).clip(0, 1) * mask[..., None]
        levels = (image_np * 255).round().astype(np.float32)
        frames.append(torch.from_numpy(levels) / 255)
        masks.append(torch.from_numpy(mask.astype(np.float32)))
    return torch.stack(frames), torch.stack(masks)


def seen_pixels(positions: Tensor, camera: Camera, effects: Sequence[OutOfFamilyEffect]) -> Tensor:
    """Where points (..., 3) [m] are seen by the camera as it really is, (..., 2) [px]."""
    pixels = camera.project(positions)
    for effect in effects:
        pixels = effect.pixels(pixels, camera)
    return pixels


def brightness_change(effect: OutOfFamilyEffect, motion: Tensor) -> float:
    """Mean relative change of brightness in the last third against frame 0 [%], for a motion (F, H, W, 3)."""
    faces = grid_faces(motion.shape[1], motion.shape[2])
    first = effect.brightness(_facing_normals(motion[0].reshape(-1, 3), faces))
    assert first is not None
    changes = []
    for positions in motion[len(motion) * 2 // 3 :]:
        later = effect.brightness(_facing_normals(positions.reshape(-1, 3), faces))
        assert later is not None
        changes.append((later / first.clamp(min=0.05) - 1).abs().mean())
    return 100 * float(torch.stack(changes).mean())


def _seen(positions: Tensor, camera: Camera, effects: Sequence[OutOfFamilyEffect]) -> Tensor:
    """Points at the same depth that the declared camera projects to where the true one sees them."""
    pixels = seen_pixels(positions, camera, effects)
    z = positions[..., 2]
    x, y = (pixels[..., 0] - camera.cx) / camera.fx * z, (pixels[..., 1] - camera.cy) / camera.fy * z
    return torch.stack((x, y, z), -1)


def _facing_normals(positions: Tensor, faces: Tensor) -> Tensor:
    """Unit normals (N, 3) on the side that the camera sees."""
    normals = vertex_normals(positions, faces)
    towards = (normals * positions).sum(-1, keepdim=True)
    return torch.where(towards > 0, -normals, normals)


def _mean_brightness(effect: OutOfFamilyEffect, pose: Tensor, faces: Tensor) -> float:
    """Mean factor at frame 0: the camera's exposure is set by it."""
    factor = effect.brightness(_facing_normals(pose.reshape(-1, 3), faces))
    assert factor is not None
    return float(factor.mean().clamp(min=0.05))


def _moments(frame: int, substeps: int, n: int, exposure: float, samples: int) -> list[float]:
    """Moments that a frame sees, in sub-steps: the middles of equal parts of the time that it is exposed."""
    centre = frame * substeps
    if exposure <= 0 or frame == 0:
        return [float(centre)]
    offsets = ((np.arange(samples) + 0.5) / samples - 0.5) * exposure * substeps
    return [float(np.clip(centre + o, 0, n - 1)) for o in offsets]
