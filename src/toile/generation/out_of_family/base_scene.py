"""What all scenes of a set have in common, drawn without a look at the effect that will act in them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, final

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from torch import Tensor

from toile.generation.motion import PinnedMotion
from toile.generation.settings import GeneratorSettings
from toile.generation.textures import procedural_texture
from toile.geometry.mesh import grid_faces
from toile.limits import Count, Fraction, Positive, TwoOrMore, Unit
from toile.physics.grid_laws import GridLaw, angles, taut
from toile.scenes.registry import load_template
from toile.scenes.template import Template

Rng = np.random.Generator
Vector = tuple[float, float, float]


@dataclass(frozen=True)
class OutOfFamilySettings:
    """What is the same for all scenes of a set.

    Attributes:
        grid: (H, W) of template and truth, which a fit uses.
        refinement: the simulated grid is finer by this factor.
        substeps: BDF2 steps per frame.
        coarse_substeps: the same while the strength of an effect is sought, on the fit's grid.
        largest_grid_share: how far a clip without effects may move otherwise on the fit's grid with
            coarse_substeps, mean of the last third [% of the width]; beyond, another scene is drawn, whatever
            its effect.
        n_frames: F.
        fps: frames per second.
        image_side: longer side of the cloth's box over the clip, with its margin [px].
        templates: names of recordings whose templates and textures are used; () for procedural sheets only.
        template_share: share of scenes that start from one.
        data: data folder of the recordings, None for TOILE_DATA.
        texture_side: of procedural textures [px].
        supersampling: samples per pixel and axis.
        blur_samples: renders that are averaged into one motion-blurred frame.
        newton_tolerance: see NewtonSettings.
    """

    grid: tuple[TwoOrMore, TwoOrMore] = (20, 20)
    refinement: Count = 2
    substeps: Count = 8
    coarse_substeps: Count = 5
    largest_grid_share: Annotated[Positive, Unit("% of the width")] = 1.5
    n_frames: Annotated[TwoOrMore, Unit("frames")] = 40
    fps: Annotated[Positive, Unit("1/s")] = 25.0
    image_side: Annotated[Count, Unit("px")] = 400
    templates: tuple[str, ...] = field(kw_only=True)
    template_share: Fraction = 0.5
    data: Path | str | None = None
    texture_side: Annotated[Count, Unit("px")] = 700
    supersampling: Count = 2
    blur_samples: Count = 7
    newton_tolerance: Positive = 1e-5


@final
@dataclass(frozen=True)
class RandomMotion(PinnedMotion):
    """Smooth motion of the pinned corners: harmonics that fade in, at rest at t = 0.

    Attributes:
        amplitudes: (K, 3) [m].
        frequencies: (K,) [Hz].
        phases: (K,) [rad].
        fade_in: [s].
    """

    amplitudes: tuple[tuple[float, float, float], ...] = ()
    frequencies: tuple[float, ...] = ()
    phases: tuple[float, ...] = ()
    fade_in: float = 0.3

    def displacement(self, times: Tensor) -> Tensor:
        """See PinnedMotion."""
        x = (times / self.fade_in).clamp(0, 1)
        fade = x * x * (3 - 2 * x)
        total = times.new_zeros(len(times), 3)
        for a, f, phase in zip(self.amplitudes, self.frequencies, self.phases, strict=True):
            wave = torch.sin(2 * math.pi * f * times + phase)
            total = total + wave[:, None] * torch.tensor(a, dtype=times.dtype)
        return fade[:, None] * total


@dataclass(frozen=True)
class BaseScene:
    """One scene before any effect.

    Attributes:
        settings: for the starting point and the film; its pinned motion is the scene's.
        template: real template on the fit's grid, or None for a procedural sheet.
        texture: printed on a procedural sheet, (h_t, w_t, 3); None with a template.
        compression: ratios of edges and diagonals of the taut law; None for the law of angles.
        turned: held by the other pair of corners, see ``turned_start``.
    """

    settings: GeneratorSettings
    template: Template | None
    texture: Tensor | None
    compression: tuple[float, float] | None = None
    turned: bool = False

    @property
    def law(self) -> GridLaw:
        """Which energies resist the deformation."""
        if self.compression is None:
            return angles
        edges, diagonals = self.compression
        return partial(taut, edge_compression=edges, diagonal_compression=diagonals)

    def describe(self) -> dict[str, object]:
        """The nuisances, as JSON values."""
        s = self.settings
        return {
            "template": None if self.template is None else self.template.name,
            "cloth_size": list(s.cloth_size),
            "areal_density": s.areal_density,
            "network_units": {"stretching": s.stretching, "shearing": s.shearing, "bending": s.bending},
            "wind": list(s.wind),
            "initial_wind": list(s.initial_wind),
            "noise": s.noise,
            "blur": s.blur,
            "pinned_motion": repr(s.pinned_motion),
            "law": "angles" if self.compression is None else "taut",
            "compression": None if self.compression is None else list(self.compression),
            "substeps": s.substeps,
        }


def draw_base(setup: OutOfFamilySettings, rng: Rng) -> BaseScene:
    """Draw material, size, wind, motion of the corners, camera, print and noise of one scene.

    Raises:
        InputError: a template of the settings is not in the data folder.
    """
    # Every number is drawn whether it is needed or not, so that scenes differ in nothing else.
    use_template = bool(setup.templates) and rng.random() < setup.template_share
    name = setup.templates[int(rng.integers(len(setup.templates)))] if setup.templates else ""
    side = float(rng.uniform(0.45, 0.7))
    size = (side, side * float(rng.uniform(0.9, 1.1)))
    tilt = math.radians(float(rng.uniform(-8, 8)))
    texture_seed = int(rng.integers(2**31))
    template = resampled(load_template(name, setup.data), setup.grid) if use_template else None
    gravity = (0.0, 9.81, 0.0) if use_template else (0.0, 9.81 * math.cos(tilt), 9.81 * math.sin(tilt))
    initial, wind = draw_winds(rng, gravity, (0.3, 1.2), (0.8, 2.4))
    stretching = math.exp(rng.uniform(math.log(150), math.log(900)))  # N/m
    shear_modulus = math.exp(rng.uniform(math.log(0.7), math.log(3.5)))  # N/m
    bending = math.exp(rng.uniform(math.log(8e-5), math.log(4e-4)))  # N·m
    settings = GeneratorSettings(
        grid=setup.grid,
        refinement=setup.refinement,
        substeps=setup.substeps,
        n_frames=setup.n_frames,
        fps=setup.fps,
        cloth_size=size if template is None else template.cloth_size,
        areal_density=float(rng.uniform(0.1, 0.25)),
        gravity=gravity,
        initial_wind=initial,
        wind=wind,
        pinned_distance=float(rng.uniform(0.94, 0.98)),
        pinned_motion=draw_motion(rng),
        distance=2.2 * side,
        yaw=float(rng.uniform(-20, 20)),
        # Generous: the film is cropped to the cloth and scaled afterwards.
        image_size=(1200, 1200),
        focal_length=1400.0,
        supersampling=setup.supersampling,
        blur=float(rng.uniform(0.3, 0.7)),
        noise=float(rng.uniform(0.004, 0.015)),
        newton_tolerance=setup.newton_tolerance,
        settled=1e-2,
        seed=int(rng.integers(2**31)),
    )
    cell = settings.cloth_size[0] * settings.cloth_size[1] / ((setup.grid[0] - 1) * (setup.grid[1] - 1))
    units = settings.units(settings.cloth_size)
    settings = replace(
        settings,
        stretching=stretching / units.stretching,
        shearing=shear_modulus * cell / units.energy,
        bending=bending / units.energy,
    )
    texture = None
    if template is None:
        texture = procedural_texture(setup.texture_side, setup.texture_side, texture_seed)
    return BaseScene(settings, template, texture)


def draw_winds(
    rng: Rng, gravity: Vector, before: tuple[float, float], after: tuple[float, float]
) -> tuple[Vector, Vector]:
    """Winds until frame 0 and from it on [m/s²], horizontal, mostly along the line of sight, opposed.

    Args:
        rng: for directions and strengths.
        gravity: [m/s²], of 9.81 m/s².
        before: least and largest strength until frame 0 [m/s²].
        after: the same from it on.
    """
    down = np.array(gravity) / 9.81
    right = np.array([1.0, 0.0, 0.0])
    ahead = np.cross(right, down)

    def horizontal(limits: tuple[float, float], side: float) -> Vector:
        angle, strength = float(rng.uniform(-0.35, 0.35) * math.pi), float(rng.uniform(*limits))
        vector = strength * (math.sin(angle) * right + math.cos(angle) * ahead)
        return side * float(vector[0]), side * float(vector[1]), side * float(vector[2])

    side = float(rng.choice((-1.0, 1.0)))
    return horizontal(before, -side), horizontal(after, side)


def draw_motion(rng: Rng, kind: int | None = None) -> RandomMotion:
    """Corners that stay (0), are shaken (1), or swing (2); None: each in a third of the scenes."""
    drawn = int(rng.integers(3))
    kind = drawn if kind is None else kind
    frequencies = rng.uniform(*((0.6, 1.6), (0.8, 1.8), (0.25, 0.55))[kind], 2)
    size = (0.0, float(rng.uniform(0.006, 0.018)), float(rng.uniform(0.03, 0.07)))[kind]
    directions = rng.standard_normal((2, 3)) * np.array([0.7, 0.25, 1.0])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    amplitudes = size * directions * np.array([[1.0], [0.5]])
    return RandomMotion(
        amplitudes=tuple((float(a), float(b), float(c)) for a, b, c in amplitudes),
        frequencies=tuple(map(float, frequencies)),
        phases=tuple(map(float, rng.uniform(0, 2 * math.pi, 2))),
        fade_in=float(rng.uniform(0.25, 0.5)),
    )


def resampled(template: Template, grid: tuple[int, int]) -> Template:
    """The template on another grid, by bicubic splines over its own; corners keep their places."""
    H, W = template.grid
    if tuple(grid) == (H, W):
        return template

    def at(values: Tensor) -> Tensor:
        result = values.double().numpy()
        for axis, (old, new) in enumerate(zip((H, W), grid, strict=True)):
            spline = CubicSpline(np.arange(old), result, axis=axis)
            result = spline(np.linspace(0, old - 1, new))
        return torch.from_numpy(result).to(values.dtype)

    pinned = tuple(
        round(k // W * (grid[0] - 1) / (H - 1)) * grid[1] + round(k % W * (grid[1] - 1) / (W - 1))
        for k in template.pinned_vertices
    )
    return replace(
        template,
        positions=at(template.positions),
        faces=grid_faces(*grid),
        texture_coordinates=at(template.texture_coordinates).clamp(0, 1),
        pinned_vertices=pinned,
    )
