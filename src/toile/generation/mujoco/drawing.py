"""What is drawn of a cloth and of a clip, whatever effect will act in them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import torch
from torch import Tensor

from toile.generation.clip_plan import ClipPlan
from toile.generation.initial_pose import hanging_sheet
from toile.generation.motion import PinnedMotion
from toile.generation.mujoco.engine import FlexMaterial, FlexSheet
from toile.generation.out_of_family.base_scene import RandomMotion
from toile.limits import Count, Positive, TwoOrMore, Unit

Rng = np.random.Generator


@dataclass(frozen=True)
class MujocoSettings:
    """What is the same for all scenes of a set.

    Attributes:
        grid: (H, W) of template and truth, which a fit uses.
        vertices: of the simulated cloth, along axis 0 and 1.
        coarse_vertices: the same while the strength of an effect is sought.
        largest_step: [s]; there are as many steps per frame as this asks for.
        largest_grid_share: how far a clip without effects may move otherwise with coarse_vertices, mean of
            the last third [% of the width]; beyond, another is drawn, whatever its effect.
        image_side: longer side of the cloth's box over the clip, with its margin [px].
        texture_side: of the print [px].
        supersampling: samples per pixel and axis.
        blur_samples: renders that are averaged into one motion-blurred frame.
    """

    grid: tuple[TwoOrMore, TwoOrMore] = (20, 20)
    vertices: tuple[TwoOrMore, TwoOrMore] = (32, 32)
    coarse_vertices: tuple[TwoOrMore, TwoOrMore] = (20, 20)
    largest_step: Annotated[Positive, Unit("s")] = 0.004
    largest_grid_share: Annotated[Positive, Unit("% of the width")] = 3.0
    image_side: Annotated[Count, Unit("px")] = 400
    texture_side: Annotated[Count, Unit("px")] = 700
    supersampling: Count = 2
    blur_samples: Count = 7

    def substeps(self, fps: float) -> int:
        """Steps per frame."""
        return math.ceil(1 / (fps * self.largest_step) - 1e-9)


@dataclass(frozen=True)
class DrawnCloth:
    """One cloth and the camera before it: what the clips of a session share.

    Attributes:
        size: rest lengths along axis 0 and 1 [m].
        areal_density: [kg/m²].
        material: see FlexMaterial.
        gravity: (3,) [m/s²].
        pinned_distance: of the pinned corners, as a fraction of the side between them.
        distance: of the cloth from the camera [m].
        yaw: of the cloth against the camera [degrees].
        texture_seed: of the print.
        blur: of the lens [px]; noise: of the sensor, in [0, 1].
    """

    size: tuple[float, float]
    areal_density: float
    material: FlexMaterial
    gravity: tuple[float, float, float]
    pinned_distance: float
    distance: float
    yaw: float
    texture_seed: int
    blur: float
    noise: float

    def sheet(self, grid: tuple[int, int], turned: bool) -> FlexSheet:
        """The cloth on a grid, pinned at its upper corners."""
        return FlexSheet(grid, self.size, self.areal_density, self.material, pinned_corners(grid, turned))


@dataclass(frozen=True)
class DrawnClip:
    """What differs from clip to clip.

    Attributes:
        motion: of the pinned corners.
        turned: held by the corners at the beginning of axis 0 instead of those at the beginning of axis 1.
        initial_wind: force per mass (3,) [m/s²]; frame 0 is the equilibrium under it.
        wind: from frame 0 on.
        seed: of the bend from which the cloth settles, and of the noise.
    """

    motion: PinnedMotion
    turned: bool
    initial_wind: tuple[float, float, float]
    wind: tuple[float, float, float]
    seed: int


def draw_cloth(rng: Rng) -> DrawnCloth:
    """Draw a soft cloth, knitted to woven: 3 to 40 times less stiff in shear than isotropic."""
    side = float(rng.uniform(0.45, 0.7))
    tilt = math.radians(float(rng.uniform(-8, 8)))
    stretching = _log_uniform(rng, 80, 600)
    return DrawnCloth(
        size=(side, side * float(rng.uniform(0.9, 1.1))),
        areal_density=float(rng.uniform(0.1, 0.25)),
        material=FlexMaterial(
            stretching=stretching,
            shearing=stretching * _log_uniform(rng, 0.01, 0.15),
            poisson=float(rng.uniform(0.05, 0.3)),
            bending=_log_uniform(rng, 6e-5, 4e-4),
            damping=_log_uniform(rng, 1e-4, 2e-3),
        ),
        gravity=(0.0, 9.81 * math.cos(tilt), 9.81 * math.sin(tilt)),
        pinned_distance=float(rng.uniform(0.94, 0.98)),
        distance=2.2 * side,
        yaw=float(rng.uniform(-20, 20)),
        texture_seed=int(rng.integers(2**31)),
        blur=float(rng.uniform(0.3, 0.7)),
        noise=float(rng.uniform(0.004, 0.015)),
    )


def draw_clip(plan: ClipPlan, gravity: tuple[float, float, float], rng: Rng) -> DrawnClip:
    """Draw motion and winds as a plan says."""
    side = float(rng.choice((-1.0, 1.0)))
    initial_range, wind_range = {
        "hang": ((0.3, 1.2), (0.8, 2.4)),
        "release": ((1.5, 4.0), (0.0, 0.0)),
        "fan_off": ((0.0, 0.0), (0.0, 0.0)),
    }.get(plan.motion, ((0.2, 0.8), (0.2, 1.0)))
    initial = _horizontal(rng, gravity, -side, *initial_range)
    wind = _horizontal(rng, gravity, side, *wind_range)
    motion = _motion(plan.motion, rng)
    return DrawnClip(
        motion=motion,
        turned=plan.motion == "turned",
        initial_wind=initial,
        wind=wind,
        seed=int(rng.integers(2**31)),
    )


def pinned_corners(grid: tuple[int, int], turned: bool) -> tuple[int, int]:
    """Flattened indices of the upper corners on a grid."""
    H, W = grid
    return (0, W - 1) if turned else (0, (H - 1) * W)


def unsettled_pose(cloth: DrawnCloth, clip: DrawnClip, grid: tuple[int, int]) -> Tensor:
    """The cloth before the camera (H, W, 3), bent, not yet at rest."""
    first, second = cloth.size
    pose = hanging_sheet(
        (grid[1], grid[0]) if clip.turned else grid,
        (second, first) if clip.turned else (first, second),
        pinned_distance=cloth.pinned_distance,
        distance=cloth.distance,
        yaw=math.radians(cloth.yaw),
        gravity=cloth.gravity,
        seed=clip.seed,
    )
    # A quarter turn in its own plane: axis 0 points down, axis 1 to the left; a transpose would mirror it.
    return pose.flip(0).transpose(0, 1).contiguous() if clip.turned else pose


def describe(cloth: DrawnCloth, clip: DrawnClip) -> dict[str, object]:
    """The nuisances, as JSON values."""
    m = cloth.material
    return {
        "template": None,
        "cloth_size": list(cloth.size),
        "areal_density": cloth.areal_density,
        "material": {
            "law": "St. Venant-Kirchhoff triangles, isometric bending",
            "stretching": m.stretching,
            "shearing": m.shearing,
            "poisson": m.poisson,
            "bending": m.bending,
            "damping": m.damping,
        },
        "wind": list(clip.wind),
        "initial_wind": list(clip.initial_wind),
        "noise": cloth.noise,
        "blur": cloth.blur,
        "pinned_motion": repr(clip.motion),
    }


def as_vector(values: tuple[float, float, float]) -> Tensor:
    """(3,), float64."""
    return torch.tensor(values, dtype=torch.float64)


def _motion(kind: str, rng: Rng) -> RandomMotion:
    """Two harmonics that fade in; none where the corners stay."""
    slow = kind == "sway"
    frequencies = rng.uniform(*((0.25, 0.55) if slow else (1.0, 2.0)), 2)
    size = float(rng.uniform(*((0.03, 0.1) if slow else (0.01, 0.03))))
    directions = rng.standard_normal((2, 3)) * np.array([0.7, 0.25, 1.0])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    phases = rng.uniform(0, 2 * math.pi, 2)
    fade_in = float(rng.uniform(0.25, 0.5))
    if kind in ("hang", "release"):
        return RandomMotion()
    amplitudes = size * directions * np.array([[1.0], [0.4]])
    return RandomMotion(
        amplitudes=tuple((float(a), float(b), float(c)) for a, b, c in amplitudes),
        frequencies=tuple(map(float, frequencies)),
        phases=tuple(map(float, phases)),
        fade_in=fade_in,
    )


def _horizontal(
    rng: Rng, gravity: tuple[float, float, float], side: float, low: float, high: float
) -> tuple[float, float, float]:
    """A force per mass orthogonal to gravity, mostly towards or away from the camera."""
    right = np.array([1.0, 0.0, 0.0])
    ahead = np.cross(right, np.array(gravity) / 9.81)
    angle, strength = float(rng.uniform(-0.35, 0.35) * math.pi), side * float(rng.uniform(low, high))
    vector = strength * (math.sin(angle) * right + math.cos(angle) * ahead)
    return float(vector[0]), float(vector[1]), float(vector[2])


def _log_uniform(rng: Rng, low: float, high: float) -> float:
    return float(math.exp(rng.uniform(math.log(low), math.log(high))))
