"""Base scenes of the fast simulator: everything but the effect, drawn without a look at it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from toile.generation.fast.kernels import SLOW
from toile.generation.fast.sheet import NORMAL, UNIFORM, Lattice, Sheet, lattice, no_series

Array = NDArray[np.float64]
Rng = np.random.Generator

GRAVITY = 9.81  # m/s², along +y
MOTIONS = ("release", "shake", "sway", "wind")
"""What a clip begins with: let go from elsewhere, shaken, swung, or wind that turns."""


@dataclass(frozen=True)
class Timing:
    """Of a clip, and of its steps.

    Attributes:
        n_frames: F.
        fps: declared frames per second.
        substeps: per frame, a multiple of what air is evaluated by.
    """

    n_frames: int
    fps: float
    substeps: int

    @property
    def n_steps(self) -> int:
        """Of the whole clip."""
        return (self.n_frames - 1) * self.substeps


@dataclass(frozen=True)
class Cloth:
    """A sheet's material and law.

    Attributes:
        grid: (H, W).
        size: along axis 1 and 0 [m].
        density: [kg/m²].
        stretching, shearing: [N/m]; bending: [N·m].
        diagonals: share of shearing by diagonals, the rest by angles.
        border_mass: of a border vertex over that of its cells.
        border_stiffness: of a border edge over an inner one's.
        parameters: of the law and of the numerical dissipation.
    """

    grid: tuple[int, int]
    size: tuple[float, float]
    density: float
    stretching: float
    shearing: float
    bending: float
    diagonals: float
    border_mass: float
    border_stiffness: float
    parameters: dict[str, float]

    def highest_frequency(self) -> float:
        """Upper bound of ω of its stiffest mode [1/s]."""
        area = self.size[0] * self.size[1] / ((self.grid[0] - 1) * (self.grid[1] - 1))
        lightest = self.density * area * self.border_mass * 0.5
        stiffest = 4 * self.border_stiffness * self.stretching + 4 * self.shearing
        return math.sqrt((stiffest + 32 * self.bending / area) / lightest)


@dataclass(frozen=True)
class Clip:
    """How one clip of a cloth is moved.

    Attributes:
        motion: one of MOTIONS.
        initial_wind, wind: force per mass before frame 0 and from then on (3,) [m/s²].
        wind_on_normals: whether wind pushes along the normals only.
        amplitudes: (2, 3) [m]; frequencies (2,) [Hz]; phases (2,) [rad]; fade_in [s]: of the corners.
        pinned_distance: of the corners, as a share of the width.
        own: (2, 2, 3) [m], amplitudes of each corner beside what both do; 0 where they move as one.
    """

    motion: str
    initial_wind: Array
    wind: Array
    wind_on_normals: bool
    amplitudes: Array
    frequencies: Array
    phases: Array
    fade_in: float
    pinned_distance: float
    own: Array

    def path(self, times: Array) -> Array:
        """Displacement of the two corners (T, 2, 3) [m] at times (T,) [s]."""
        x = np.clip(times / self.fade_in, 0, 1)
        waves = np.sin(2 * np.pi * times[:, None] * self.frequencies + self.phases)
        both = np.einsum("tk,pkc->tpc", waves, self.amplitudes + self.own)
        path: Array = (x * x * (3 - 2 * x))[:, None, None] * both
        return path


def draw_cloth(rng: Rng, grid: tuple[int, int]) -> Cloth:
    """Material, law and dissipation of a cloth, over wider ranges than those of generated scenes."""

    def log(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    side = rng.uniform(0.4, 0.75)
    shearing = log(0.5, 5.0) if rng.random() < 0.75 else log(5.0, 40.0)
    compression = rng.uniform(0, 1, 2) ** 2 if rng.random() < 0.6 else np.ones(2)
    parameters = {
        "compression_edge": max(float(compression[0]), 0.05),
        "compression_diagonal": float(compression[1]),
        "softening_edge": float(rng.uniform(-1.5, 0)),
        "softening_diagonal": float(rng.uniform(-1.5, 0)),
        # What is left of a direction within the surface is a second law of bending.
        "in_plane": float(rng.random() < 0.5),
        "decay": float(rng.choice((0.0, log(0.005, 0.2)))),
        "viscosity": log(0.05, 20.0),
        "time_shear": log(3e-4, 6e-3),
        "time_bend": log(3e-4, 6e-3),
    }
    kind = rng.random()
    cloth = Cloth(
        grid=grid,
        size=(float(side), float(side * rng.uniform(0.85, 1.15))),
        density=log(0.08, 0.3),
        stretching=log(120, 1000),
        shearing=shearing,
        bending=log(5e-5, 6e-4),
        diagonals=0.0 if kind < 0.35 else 1.0 if kind < 0.8 else float(rng.uniform()),
        border_mass=float(rng.uniform(0.75, 1.0) if rng.random() < 0.5 else 1.0),
        border_stiffness=float(rng.choice((0.5, 1.0))),
        parameters=parameters,
    )
    # Stiff and light cloth would need ever shorter steps; that it stretches by 0.1 or 0.2 % is not seen.
    excess = (cloth.highest_frequency() * _LONGEST_STEP / _STABLE) ** 2
    return replace(cloth, stretching=cloth.stretching / max(excess, 1.0))


_STABLE = 1.2
"""Step times ω; 2 is the limit, and effects stiffen."""
_LONGEST_STEP = 2.5e-4  # s


def draw_clip(rng: Rng, motion: str) -> Clip:
    """Wind and motion of the corners of one clip."""

    def horizontal(low: float, high: float) -> Array:
        angle, strength = rng.uniform(-0.35, 0.35) * np.pi, rng.uniform(low, high)
        return np.array([strength * np.sin(angle), 0.0, strength * np.cos(angle)])

    side = float(rng.choice((-1.0, 1.0)))
    wind = side * horizontal(0.8, 2.4) if motion == "wind" else side * horizontal(0, 1)
    if motion == "wind" or rng.random() < 0.2:
        initial = -side * horizontal(0.3, 1.2)
    elif motion == "release":
        initial = side * horizontal(1.5, 5.0)
    else:
        initial = wind + horizontal(0.0, 0.3)
    kind = 1 if motion == "shake" else 2 if motion == "sway" else 0
    if motion == "wind":
        kind = int(rng.integers(3))
    frequencies = rng.uniform(*((0.6, 1.6), (0.8, 2.2), (0.25, 0.6))[kind], 2)
    size = (0.0, rng.uniform(0.006, 0.02), rng.uniform(0.03, 0.08))[kind]
    directions = rng.standard_normal((2, 3)) * np.array([0.7, 0.25, 1.0])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    # Two hands, or a hand that turns: corners that move apart are no slip.
    own = np.zeros((2, 2, 3))
    if rng.random() < 0.5:
        own = rng.uniform(0.005, 0.04) * rng.standard_normal((2, 2, 3)) * np.array([0.5, 0.5, 1.0])
        own *= np.array([[1.0], [0.5]])
    return Clip(
        motion=motion,
        initial_wind=initial,
        wind=wind,
        wind_on_normals=bool(rng.random() < 0.5),
        amplitudes=size * directions * np.array([[1.0], [0.5]]),
        frequencies=frequencies,
        phases=rng.uniform(0, 2 * np.pi, 2),
        fade_in=float(rng.uniform(0.25, 0.5)),
        pinned_distance=float(rng.uniform(0.92, 0.995)),
        own=own,
    )


def draw_timing(rng: Rng) -> Timing:
    """Frames and steps of a batch of clips of about 1.6 s, most at 50 or 25 frames per second."""
    kinds = ((80, 50.0), (40, 25.0), (50, 30.0), (64, 50.0))
    n_frames, fps = kinds[int(rng.choice(4, p=(0.5, 0.3, 0.1, 0.1)))]
    return Timing(n_frames, fps, SLOW * math.ceil(1 / (fps * _LONGEST_STEP * SLOW)))


def make_sheet(cloth: Cloth, clip: Clip, timing: Timing, interval_ratio: float = 1.0) -> Sheet:
    """The sheet of one clip without any effect.

    Args:
        cloth: material.
        clip: wind and corners.
        timing: of frames and steps.
        interval_ratio: true time between frames over the declared one.
    """
    return _sheet(
        cloth, clip, interval_ratio / (timing.fps * timing.substeps), timing.n_steps, clip.wind, moving=True
    )


def settling_sheet(cloth: Cloth, clip: Clip) -> Sheet:
    """The same sheet before frame 0: initial wind, corners at rest, slowed down."""
    sheet = _sheet(cloth, clip, _LONGEST_STEP, _SETTLING_STEPS, clip.initial_wind, moving=False)
    sheet.parameters["decay"] = 7.0
    sheet.parameters["viscosity"] = 40.0
    return sheet


_SETTLING_STEPS = 3600  # 0.9 s


def flat_start(cloth: Cloth, clip: Clip) -> Array:
    """Positions (N, 3) from which a sheet settles: flat below its corners, off the vertical by the wind."""
    places = lattice(cloth.grid).places
    lean = np.arctan2(clip.initial_wind[2], GRAVITY)
    x = (places[:, 1] - 0.5) * cloth.size[0] * clip.pinned_distance
    # Slack between the corners hangs down in the middle.
    sag = 0.35 * np.sqrt(1 - clip.pinned_distance) * cloth.size[0]
    down = places[:, 0] * cloth.size[1] + sag * np.sin(np.pi * places[:, 1]) * (1 - 0.5 * places[:, 0])
    return np.stack([x, down * np.cos(lean), down * np.sin(lean)], -1)


def _sheet(cloth: Cloth, clip: Clip, step: float, n_steps: int, wind: Array, *, moving: bool) -> Sheet:
    grid: Lattice = lattice(cloth.grid)
    area = cloth.size[0] * cloth.size[1] / len(grid.cells)
    inner = grid.areas > 0.75
    masses: Array = (
        cloth.density * area * grid.areas.astype(np.float64) * np.where(inner, 1.0, cloth.border_mass)
    )
    kinds = grid.springs[:, 2]
    border = (~inner)[grid.springs[:, :2]].all(1) & (kinds < 2)
    stretching = cloth.stretching * np.where(border, cloth.border_stiffness, 1.0)
    springs = np.where(kinds < 2, stretching, cloth.shearing * cloth.diagonals)
    series = no_series(n_steps)
    series[:, NORMAL if clip.wind_on_normals else UNIFORM] = wind
    start = flat_start(cloth, clip)[list(grid.corners)]
    times = step * np.arange(1.0, n_steps + 1)
    path = clip.path(times) if moving else np.zeros((n_steps, 2, 3))
    return Sheet(
        lattice=grid,
        size=cloth.size,
        step=step,
        parameters=dict(cloth.parameters) | {"gravity_y": GRAVITY, "vertex_mass": cloth.density * area},
        masses=masses,
        springs=springs,
        cells=np.full(len(grid.cells), cloth.shearing * (1 - cloth.diagonals)),
        straights=np.full(len(grid.straights), cloth.bending),
        rest_bends=np.zeros(len(grid.straights)),
        boundary=start + path,
        series=series,
    )
