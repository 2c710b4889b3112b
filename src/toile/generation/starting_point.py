"""From settings, or a real template, to the simulated sheet at rest in frame 0."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from toile.generation.initial_pose import hanging_sheet, settle
from toile.generation.refinement import refine, refined_material, refined_vertices
from toile.generation.settings import GeneratorSettings
from toile.generation.simulation import Sheet
from toile.geometry.camera import Camera
from toile.physics.grid_laws import GridLaw, angles
from toile.scenes.template import Template

_EXCESS = 1.01  # a side is at least this much longer than the distance of the corners pinned at its ends


@dataclass(frozen=True)
class StartingPoint:
    """What settings and template determine before anything is simulated.

    Attributes:
        pose: positions on the fit's grid (H, W, 3) [m], float64, not yet in equilibrium.
        cloth_size: rest length of the sides [m].
        pinned: flattened indices of pinned vertices on the fit's grid.
        camera: camera of the whole image.
    """

    pose: Tensor
    cloth_size: tuple[float, float]
    pinned: tuple[int, ...]
    camera: Camera


def starting_point(settings: GeneratorSettings, template: Template | None) -> StartingPoint:
    """Starting point of a procedural sheet pinned at its upper corners, or of a real template."""
    if template is not None:
        return StartingPoint(
            template.positions,
            _measured_size(template),
            template.pinned_vertices,
            template.camera.scaled(settings.image_scale),
        )
    H, W = settings.grid
    pose = hanging_sheet(
        settings.grid,
        settings.cloth_size,
        pinned_distance=settings.pinned_distance,
        distance=settings.distance,
        yaw=math.radians(settings.yaw),
        gravity=settings.gravity,
        seed=settings.seed,
    )
    height, width = settings.image_size
    f = settings.focal_length
    camera = Camera(f, f, width / 2, height / 2, height, width).scaled(settings.image_scale)
    return StartingPoint(pose, settings.cloth_size, (0, (H - 1) * W), camera)


def settled_sheet(settings: GeneratorSettings, start: StartingPoint, law: GridLaw = angles) -> Sheet:
    """The refined sheet in equilibrium under gravity and the initial wind.

    The coarse sheet settles first; from its equilibrium the fine one has little left to do.
    """
    material = settings.material(start.cloth_size)
    acceleration = torch.tensor(settings.gravity, dtype=torch.float64) + torch.tensor(
        settings.initial_wind, dtype=torch.float64
    )
    sheet = Sheet.of(start.pose, start.cloth_size, settings.areal_density, start.pinned, material, law)
    sheet = settle(sheet, acceleration, settings.newton, tolerance=settings.settled)
    if settings.refinement == 1:
        return sheet
    fine = Sheet.of(
        refine(sheet.pose, settings.refinement),
        start.cloth_size,
        settings.areal_density,
        refined_vertices(start.pinned, settings.grid, settings.refinement),
        refined_material(material, settings.refinement),
        law,
    )
    return settle(fine, acceleration, settings.newton, tolerance=settings.settled)


def _measured_size(template: Template) -> tuple[float, float]:
    """Sides [m] by the template's mean edge lengths, but long enough to reach between pinned corners."""
    p = template.positions
    H, W = template.grid
    sides = []
    for axis, n in ((0, H), (1, W)):
        mean = float(p.diff(dim=axis).norm(dim=-1).mean()) * (n - 1)
        ends = {0: (0, (H - 1) * W), 1: (0, W - 1)}[axis]
        chord = 0.0
        if set(ends) <= set(template.pinned_vertices):
            flat = p.reshape(-1, 3)
            chord = float((flat[ends[0]] - flat[ends[1]]).norm())
        sides.append(max(mean, _EXCESS * chord))
    return sides[0], sides[1]
