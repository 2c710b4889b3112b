"""Effects of the fast simulator: what moves a sheet beside its base law, two or more forms of each.

Forms and usual strengths are those of ``toile.generation.out_of_family`` and others beside them. A function
changes a sheet; its shape is drawn from ``rng``, and ``strength`` 1 is an ordinary amount.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from toile.effects.base import Scope
from toile.generation.fast.scenes import GRAVITY
from toile.generation.fast.sheet import NORMAL, PRESSURE, SCALE, UNIFORM, Sheet

Array = NDArray[np.float64]
Rng = np.random.Generator

NONE, OUTSIDE = "none", "outside"


@dataclass(frozen=True)
class Around:
    """What an effect may know of its clip: the clip without it.

    Attributes:
        motion: (F, N, 3) [m].
        width: mean of the sides [m].
        duration: [s].
    """

    motion: Array
    width: float
    duration: float


def _ramp(x: Array) -> Array:
    x = np.clip(x, 0, 1)
    result: Array = x * x * (3 - 2 * x)
    return result


def _horizontal(rng: Rng) -> Array:
    angle = rng.uniform(0, 2 * np.pi)
    return np.array([np.cos(angle), 0.0, np.sin(angle)])


def gusts(sheet: Sheet, rng: Rng, strength: float, around: Around) -> None:
    """Force that changes in time: harmonics and pulses, half waves, or noise; uniform or on normals."""
    t, duration = sheet.slow_times, around.duration
    kind = int(rng.integers(3))
    if kind == 0:
        frequencies, phases = rng.uniform(0.7, 4.0, 12), rng.uniform(0, 2 * np.pi, 12)
        angles, weights = rng.uniform(0, 2 * np.pi, 12), rng.rayleigh(1.0, 12) / np.sqrt(12)
        waves = weights * np.sin(2 * np.pi * t[:, None] * frequencies + phases)
        force = np.stack([waves @ np.cos(angles), 0 * t, waves @ np.sin(angles)], -1)
        for _ in range(2):
            begin, length = rng.uniform(0.05, 0.65) * duration, rng.uniform(0.2, 0.4)
            pulse = _ramp((t - begin) / (0.35 * length)) * _ramp((begin + length - t) / (0.35 * length))
            force += rng.uniform(1.5, 3.0) * pulse[:, None] * _horizontal(rng)
    elif kind == 1:
        modes = np.sin(np.pi * t[:, None] * np.arange(1, 7) / duration)
        coefficients = rng.standard_normal((6, 3)) * (1, 0, 1)
        force = modes @ coefficients
    else:
        correlation = rng.uniform(0.05, 0.25) / (t[1] - t[0])
        noise = gaussian_filter1d(rng.standard_normal((len(t), 3)) * (0.7, 0, 1), correlation, axis=0)
        force = 1.5 * noise / np.sqrt((noise**2).mean() * 3) * _ramp(t / 0.1)[:, None]
    law = UNIFORM if rng.random() < 0.6 else NORMAL
    sheet.series[:, law] += strength * force


def air_drag(sheet: Sheet, rng: Rng, strength: float, around: Around) -> None:
    """Drag with the velocity to the power of 1, 1.5 or 2, more across the surface than along it."""
    name, rate = (("drag", 1.5), ("drag_root", 3.0), ("drag_speed", 4.0))[int(rng.integers(3))]
    sheet.parameters[name] = rate * strength
    sheet.parameters["tangential"] = float(rng.uniform(0.05, 0.4) if rng.random() < 0.7 else 1.0)


def internal_damping(sheet: Sheet, rng: Rng, strength: float, around: Around) -> None:
    """Kelvin-Voigt in shear and bending, or friction between neighbours whatever the stiffness."""
    if rng.random() < 0.6:
        shear, bend = 0.01 * strength * rng.uniform(0.5, 1.5), 0.01 * strength * rng.uniform(1.0, 3.0)
        stiffest = max(float(sheet.springs[sheet.lattice.springs[:, 2] == 2].max()), float(sheet.cells.max()))
        lightest = float(sheet.masses.min())
        # A time step of damping must not reverse a velocity.
        most = 0.25 * lightest / (8 * max(stiffest, 0.1) * sheet.step)
        area = sheet.lengths[0] * sheet.lengths[1]
        most_bend = 0.25 * lightest * area / (32 * float(sheet.straights.max()) * sheet.step)
        sheet.parameters["time_shear"] += min(float(shear), most)
        sheet.parameters["time_bend"] += min(float(bend), most_bend)
    else:
        sheet.parameters["viscosity"] += min(15.0 * strength, 0.08 / sheet.step)


def anisotropic_stiffness(sheet: Sheet, rng: Rng, strength: float, around: Around) -> None:
    """One direction stiffer: stretching and bending by different ratios, by one, or bending alone."""
    sign = float(rng.choice((-1.0, 1.0)))
    kind = int(rng.integers(3))
    a, b = float(rng.uniform(0.3, 0.7)), float(rng.uniform(0.8, 1.4))
    a = (a, b, 0.0)[kind]
    kinds = sheet.lattice.springs[:, 2]
    along = np.where(kinds == 0, 1.0, np.where(kinds == 1, -1.0, 0.0))
    sheet.springs = sheet.springs * np.exp(0.5 * sign * min(strength * a, 2.0) * along)
    direction = np.where(np.arange(len(sheet.straights)) < sheet.lattice.n_along, 1.0, -1.0)
    sheet.straights = sheet.straights * np.exp(0.5 * sign * min(strength * b, 4.5) * direction)


def strain_stiffening(sheet: Sheet, rng: Rng, strength: float, around: Around) -> None:
    """Stiffness that grows with strain, in proportion or with its square."""
    p = sheet.parameters
    if rng.random() < 0.5:
        p["linear_edge"] = strength * float(rng.uniform(20, 60))
        p["linear_shear"] = strength * float(rng.uniform(4, 10))
    else:
        p["square_edge"] = strength * float(rng.uniform(1000, 4000))
        p["square_shear"] = strength * float(rng.uniform(25, 100))


def rest_curvature(sheet: Sheet, rng: Rng, strength: float, around: Around) -> None:
    """Cloth that is curved at rest: in a band, all of it, or in ripples."""
    grid = sheet.lattice
    axis = int(rng.integers(2))
    across = (np.arange(len(grid.straights)) >= grid.n_along) == (axis == 0)
    place = grid.places[grid.straights[:, 1], axis]
    kind = int(rng.integers(3))
    centre, width = rng.uniform(0.3, 0.8), rng.uniform(0.12, 0.3)
    ripples = np.sin(2 * np.pi * (rng.uniform(1, 2.5) * place + rng.uniform()))
    shape = (np.abs(place - centre) <= 0.5 * width, np.full(len(place), 0.5), ripples)[kind]
    sheet.rest_bends = sheet.rest_bends + 6.0 * float(rng.choice((-1.0, 1.0))) * strength * shape * across


def _patches(places: Array, rng: Rng) -> Array:
    n = int(rng.integers(2, 4))
    centres, radii = rng.uniform((0.1, 0.25), (0.9, 0.95), (n, 2)), rng.uniform(0.12, 0.25, n)
    weights = rng.uniform(0.6, 1.0, n)
    distance = np.linalg.norm(places[:, None] - centres, axis=-1) / radii
    field: Array = (weights * np.exp(-(distance**4))).sum(-1)
    return field


def _field(places: Array, rng: Rng) -> Array:
    """Where something differs, 0 to about 1: patches, a gradient, or a stripe along an edge."""
    kind = int(rng.integers(3))
    if kind == 0:
        return _patches(places, rng)
    axis = int(rng.integers(2))
    place = places[:, axis] if rng.random() < 0.7 else 1 - places[:, axis]
    if kind == 1:
        return place
    return 1 - _ramp((1 - place) / rng.uniform(0.12, 0.3))


def nonuniform_density(sheet: Sheet, rng: Rng, strength: float, around: Around) -> None:
    """More mass in patches, towards an edge, or along it."""
    sheet.masses = sheet.masses * (1 + min(strength, 8.0) * _field(sheet.lattice.places, rng))


def nonuniform_stiffness(sheet: Sheet, rng: Rng, strength: float, around: Around) -> None:
    """Stiffer in patches, towards an edge, or along it."""
    grid = sheet.lattice
    factor = np.exp(min(strength, 5.0) * _field(grid.places, rng))
    ends = factor[grid.springs[:, :2]].mean(1)
    # Edges are near the limit of the step; diagonals, cells and bends are far from it.
    limit = np.where(grid.springs[:, 2] < 2, 2.5, 20.0)
    sheet.springs = sheet.springs * np.minimum(ends, limit)
    sheet.cells = sheet.cells * np.minimum(factor[grid.cells].mean(1), 20.0)
    sheet.straights = sheet.straights * np.minimum(factor[grid.straights[:, 1]], 60.0)


def contact(sheet: Sheet, rng: Rng, strength: float, around: Around) -> None:
    """A plane or a ball in the way; at strength 1 it reaches up to the pose of frame 0."""
    turn = rng.uniform(-0.25, 0.25)
    normal = np.array([np.sin(turn), 0.0, np.cos(turn)])
    moved = (around.motion - around.motion[0]) @ normal
    normal = normal if moved.max() >= -moved.min() else -normal
    along = around.motion @ normal
    margin = 0.01 * around.width
    share = min(strength, 1.0)
    radius, friction = rng.uniform(0.25, 0.45) * around.width, rng.uniform(0.1, 0.5)
    p = sheet.parameters
    p["friction"] = float(friction)
    p["normal_x"], p["normal_y"], p["normal_z"] = (float(c) for c in normal)
    if rng.random() < 0.5:
        offset = along[0].max() + margin
        p["plane"] = 1.0
        p["offset"] = float(offset + (1 - share) * max(along.max() - offset, margin))
        return
    vertex = int((along - along[0]).max(0).argmax())
    centre = around.motion[0, vertex] + normal * (radius + margin)
    for _ in range(200):
        if np.linalg.norm(around.motion[0] - centre, axis=-1).min() >= radius + margin:
            break
        centre = centre + margin * normal
    centre = centre + (1 - share) * (along - along[0])[:, vertex].max() * normal
    p["ball"], p["radius"] = 1.0, float(radius)
    p["centre_x"], p["centre_y"], p["centre_z"] = (float(c) for c in centre)


def gravity_tilt(sheet: Sheet, rng: Rng, strength: float, around: Around) -> None:
    """Gravity off the declared direction."""
    angle, towards = np.radians(2 * min(strength, 8.0)), _horizontal(rng)
    if rng.random() < 0.3:
        towards = np.array([0, 0, np.sign(towards[2])])
    gravity = GRAVITY * (np.cos(angle) * np.array([0, 1.0, 0]) + np.sin(angle) * towards)
    for name, value in zip(("gravity_x", "gravity_y", "gravity_z"), gravity, strict=True):
        sheet.parameters[name] = float(value)


def frame_rate(sheet: Sheet, rng: Rng, strength: float, around: Around) -> None:
    """Nothing but another interval, see interval_ratio."""


def anchor_slip(sheet: Sheet, rng: Rng, strength: float, around: Around) -> None:
    """A corner that slips inwards, in jumps or slowly."""
    corner = int(rng.integers(2))
    flat = around.motion[0]
    inwards = flat.mean(0) - flat[sheet.lattice.corners[corner]]
    across = rng.standard_normal(3)
    direction = inwards / np.linalg.norm(inwards) + 0.3 * across / np.linalg.norm(across)
    direction /= np.linalg.norm(direction)
    t, duration = sheet.times, around.duration
    if rng.random() < 0.65:
        n = int(rng.integers(1, 5))
        begins, heights = rng.uniform(0.1, 0.75, n) * duration, rng.uniform(0.4, 1.0, n)
        path = sum(h * _ramp((t - b) / 0.06) for b, h in zip(begins, heights / heights.sum(), strict=True))
    else:
        begin, length = rng.uniform(0, 0.4) * duration, rng.uniform(0.2, 0.6) * duration
        path = _ramp((t - begin) / length)
    slip = 0.02 * around.width * strength * np.asarray(path)
    sheet.boundary = sheet.boundary.copy()
    sheet.boundary[:, corner] += slip[:, None] * direction


def internal_pressure(sheet: Sheet, rng: Rng, strength: float, around: Around) -> None:
    """More pressure on one side, pulsing."""
    sign, frequency, phase = rng.choice((-1.0, 1.0)), rng.uniform(0.5, 1.5), rng.uniform(0, 2 * np.pi)
    wave = 1 + 0.5 * np.sin(2 * np.pi * frequency * sheet.slow_times + phase)
    sheet.series[:, PRESSURE] += sign * strength * wave


def vortex_field(sheet: Sheet, rng: Rng, strength: float, around: Around) -> None:
    """Air that turns about an axis before the cloth."""
    spread = 0.3 * around.width * rng.standard_normal(3) * (0.7, 0.7, 0.4)
    centre = around.motion[0].mean(0) + spread
    axis = np.array([0, 1.0, 0]) + 0.4 * rng.standard_normal(3)
    axis *= rng.choice((-1.0, 1.0)) / np.linalg.norm(axis)
    p = sheet.parameters
    p["vortex"] = 8.0 * strength
    for name, value in zip("xyz", centre, strict=True):
        p[f"vortex_{name}"] = float(value)
    for name, value in zip("xyz", axis, strict=True):
        p[f"axis_{name}"] = float(value)
    p["inverse_vortex_radius"] = float(1 / (rng.uniform(0.25, 0.5) * around.width))


def plastic_creases(sheet: Sheet, rng: Rng, strength: float, around: Around) -> None:
    """Bends that stay where the cloth was bent."""
    sheet.straights = sheet.straights * (1 + 4 * strength)
    length = 0.5 * sum(sheet.lengths)
    sheet.parameters["yield_bend"] = float(rng.uniform(0.3, 1.5)) * length**2
    sheet.parameters["yield_rate"] = min(float(rng.uniform(4, 10)) * 4 * sheet.step, 1.0)


def shrinking(sheet: Sheet, rng: Rng, strength: float, around: Around) -> None:
    """Sides that become shorter while the cloth is filmed."""
    begin = rng.uniform(0, 0.2) * around.duration
    done = 1 - np.exp(-np.maximum(sheet.slow_times - begin, 0) / (0.4 * around.duration))
    shares = np.minimum(0.02 * strength * rng.uniform(0.7, 1.3, 2), 0.25)
    sheet.series[:, SCALE] *= 1 - done[:, None] * shares


Change = Callable[[Sheet, Rng, float, Around], None]


@dataclass(frozen=True)
class FastEffect:
    """One effect.

    Attributes:
        name: in the catalogue, or of one outside it.
        label: what a diagnosis should answer.
        change: see the module.
        scope: what it belongs to.
        limit: largest strength.
    """

    name: str
    label: str
    change: Change
    scope: Scope = Scope.CLOTH
    limit: float = 40.0


EFFECTS: Mapping[str, FastEffect] = MappingProxyType(
    {
        effect.name: effect
        for effect in (
            FastEffect("gusts", "gusts", gusts, Scope.CLIP),
            FastEffect("air_drag", "air_drag", air_drag),
            FastEffect("internal_damping", "internal_damping", internal_damping),
            FastEffect("anisotropic_stiffness", "anisotropic_stiffness", anisotropic_stiffness, limit=4.0),
            FastEffect("strain_stiffening", "strain_stiffening", strain_stiffening, limit=10.0),
            FastEffect("rest_curvature", "rest_curvature", rest_curvature),
            FastEffect("nonuniform_density", "nonuniform_density", nonuniform_density, limit=8.0),
            FastEffect("nonuniform_stiffness", "nonuniform_stiffness", nonuniform_stiffness, limit=5.0),
            FastEffect("contact", "contact", contact, Scope.CLIP, limit=1.0),
            FastEffect("gravity_tilt", "gravity_tilt", gravity_tilt, Scope.DEVICE, limit=8.0),
            FastEffect("frame_rate", "frame_rate", frame_rate, Scope.DEVICE, limit=8.0),
            FastEffect("anchor_slip", "anchor_slip", anchor_slip, Scope.CLIP),
            FastEffect("internal_pressure", OUTSIDE, internal_pressure, Scope.CLIP),
            FastEffect("vortex_field", OUTSIDE, vortex_field, Scope.CLIP),
            FastEffect("plastic_creases", OUTSIDE, plastic_creases, limit=12.0),
            FastEffect("shrinking", OUTSIDE, shrinking, limit=12.0),
        )
    }
)
"""All effects by name."""

LABELS = (NONE, *dict.fromkeys(e.label for e in EFFECTS.values() if e.label != OUTSIDE), OUTSIDE)
"""What a clip can be called."""


def interval_ratio(name: str, seed: tuple[int, ...], strength: float) -> float:
    """True time between frames over the declared one."""
    if name != "frame_rate":
        return 1.0
    sign = float(np.random.default_rng(seed).choice((-1.0, 1.0)))
    return float(np.exp(0.03 * sign * min(strength, 8.0)))
