"""Scenes with a known truth, from the project's own solver and renderer on a finer grid than a fit uses.

A fit on the same grid with the same step would recover its own errors along with the parameters (the inverse
crime), so the motion is simulated on a refined grid with many sub-steps and rendered from that grid.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from scipy.ndimage import gaussian_filter
from torch import Tensor

from toile.errors import InputError
from toile.generation.refinement import coarsen, refine, refined_size
from toile.generation.settings import GeneratorSettings, wrong_setting
from toile.generation.simulation import simulate
from toile.generation.starting_point import settled_sheet, starting_point
from toile.generation.truth import describe, write
from toile.geometry.camera import Camera
from toile.geometry.mesh import grid_faces
from toile.progress import Report, counted, silent
from toile.rendering.warp import WarpRenderer
from toile.scenes.masks import Box
from toile.scenes.scene import GroundTruth, Scene
from toile.scenes.template import Template
from toile.scenes.texture_coordinates import project_coordinates

__all__ = ["GeneratorSettings", "generate", "write"]


def generate(
    settings: GeneratorSettings,
    texture: Tensor | None = None,
    template: Template | None = None,
    *,
    report: Report = silent,
) -> tuple[Scene, dict[str, Any]]:
    """Simulate and render a scene.

    The template of the scene is the true frame 0, its texture is frame 0 itself and its texture coordinates
    are the projected template, as in the published recordings. Images are rounded to 8 bits, so that the
    scene read back from disk is the same.

    Args:
        settings: see GeneratorSettings.
        texture: what is printed on the cloth, (h_t, w_t, 3), float32 in [0, 1]: axis 0 of the grid runs along
            its rows from left to right and axis 1 down. None for the template's own.
        template: real template to start from (grid as in the settings): its pose settles to an equilibrium;
            its camera, pinned vertices and mean edge lengths replace those of the settings.
        report: told how far it is.

    Returns:
        The scene, and the truth as JSON values (truth.describe).

    Raises:
        InputError: neither texture nor template, another grid, or a cloth that leaves the image.
        SimulationError: the motion cannot be simulated.
    """
    if texture is None and template is None:
        raise wrong_setting("texture", "a texture, or a template that has one", None)
    if template is not None and template.grid != tuple(settings.grid):
        raise wrong_setting("template", f"a grid of {settings.grid} as in the settings", template.grid)
    start = starting_point(settings, template)
    report("settling", 0, None)
    sheet = settled_sheet(settings, start)
    motion = simulate(
        sheet,
        pinned_motion=settings.pinned_motion,
        acceleration=torch.tensor(settings.gravity, dtype=torch.float64)
        + torch.tensor(settings.wind, dtype=torch.float64),
        n_frames=settings.n_frames,
        fps=settings.fps,
        substeps=settings.substeps,
        newton=settings.newton,
        report=report,
    )
    printed = _print(settings, texture, template)
    camera, frames, masks, crop = _film(settings, start.camera, motion, *printed, report)
    vertices = coarsen(motion, settings.refinement)
    scene = Scene(
        name=settings.name,
        frames=frames,
        masks=masks,
        camera=camera,
        texture=frames[0],
        texture_coordinates=project_coordinates(vertices[0], camera),
        template=vertices[0],
        cloth_size=start.cloth_size,
        gravity=torch.tensor(settings.gravity, dtype=torch.float64),
        fps=settings.fps,
        pinned_vertices=start.pinned,
        crop=crop,
        original_size=(start.camera.height, start.camera.width),
        ground_truth=GroundTruth(vertices=vertices),
    )
    return scene, describe(settings, start, template)


def _film(
    settings: GeneratorSettings,
    full: Camera,
    motion: Tensor,
    texture: Tensor,
    coordinates: Tensor,
    report: Report,
) -> tuple[Camera, Tensor, Tensor, tuple[int, int]]:
    """Render the simulated grid (F, H', W', 3): camera, frames, masks, and (top, left) of the crop."""
    box = _visible_box(full.project(motion), full, settings.crop_margin)
    camera = full.crop(box.top, box.left, box.height, box.width)
    renderer = WarpRenderer(settings.supersampling)
    faces = grid_faces(motion.shape[1], motion.shape[2])
    rng = np.random.default_rng([settings.seed, 1])
    frames, masks = [], []
    for vertices in counted(motion.reshape(len(motion), 1, -1, 3), report, "frames", len(motion)):
        images = renderer.render(vertices, faces, coordinates.reshape(-1, 2), texture, camera)
        rgb, mask = _expose(settings, images.rgb[0], images.silhouette[0], rng)
        frames.append(rgb)
        masks.append(mask)
    return camera, torch.stack(frames), torch.stack(masks), (box.top, box.left)


def _expose(
    settings: GeneratorSettings, rgb: Tensor, silhouette: Tensor, rng: np.random.Generator
) -> tuple[Tensor, Tensor]:
    """Blur, noise and 8-bit rounding of one image (h, w, 3); mask (h, w) of 0 and 1; black background."""
    image, coverage = rgb.numpy(), silhouette.numpy()
    if settings.blur > 0:
        image = gaussian_filter(image, (settings.blur, settings.blur, 0))
        coverage = gaussian_filter(coverage, settings.blur)
    mask = coverage > 0.5
    image = image + settings.noise * rng.standard_normal(image.shape) * mask[..., None]
    levels = (image.clip(0, 1) * 255).round().astype(np.float32)
    return torch.from_numpy(levels) / 255, torch.from_numpy(mask.astype(np.float32))


def _print(
    settings: GeneratorSettings, texture: Tensor | None, template: Template | None
) -> tuple[Tensor, Tensor]:
    """Texture and the coordinates (H', W', 2) of the simulated grid in it."""
    if texture is None:
        assert template is not None
        return template.texture, refine(template.texture_coordinates, settings.refinement)
    u, v = (
        torch.linspace(0, 1, n, dtype=torch.float32) for n in refined_size(settings.grid, settings.refinement)
    )
    return texture, torch.stack(torch.meshgrid(u, v, indexing="ij"), -1)


def _visible_box(pixels: Tensor, camera: Camera, margin: int | None) -> Box:
    """Part of the image that is kept, for a cloth that projects to pixels (F, H', W', 2)."""
    low, high = pixels.reshape(-1, 2).amin(0), pixels.reshape(-1, 2).amax(0)
    size = torch.tensor([camera.width, camera.height], dtype=pixels.dtype)
    if not bool((low >= 0).all() and (high <= size).all()):
        raise InputError(
            "The cloth leaves the image",
            where="distance, focal_length, image_size, wind",
            expected=f"pixels within {camera.width} × {camera.height} (width x height)",
            got=f"x from {float(low[0]):.0f} to {float(high[0]):.0f}, "
            f"y from {float(low[1]):.0f} to {float(high[1]):.0f}",
        )
    if margin is None:
        return Box(0, 0, camera.height, camera.width)
    left, top = (max(0, int(x) - margin) for x in low)
    right, bottom = (min(int(n), int(x) + 1 + margin) for x, n in zip(high, size, strict=True))
    return Box(top, left, bottom - top, right - left)
