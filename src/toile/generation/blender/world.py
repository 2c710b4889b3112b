"""What Blender is asked to simulate and film for given settings."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid
from scipy.spatial.transform import Rotation

from toile.generation.blender.settings import BlenderSettings
from toile.physics.simulator import SimulationError

Array = NDArray[np.float64]

_REFERENCE = 63
_FADE_IN = 0.3  # [s]


def refinement(settings: BlenderSettings, *, with_effect: bool) -> tuple[int, int]:
    """Cells of the simulated grid per cell of the fit's, along both axes."""
    ratio = settings.values.get("ratio", 1.0) if with_effect else 1.0
    return settings.refinement, settings.refinement * int(ratio)


def simulation(
    settings: BlenderSettings, name: str, *, with_effect: bool, twin: Array | None = None
) -> dict[str, Any]:
    """Request for the motion, with the effect or without.

    Args:
        settings: of the scene.
        name: of the file for the result.
        with_effect: False for the twin that shares everything but the effect.
        twin: its motion (F, H', W', 3) [m]; contact needs it to find the place.

    Raises:
        SimulationError: there is no place for the sphere of a contact.
    """
    values = settings.values if with_effect else {}
    effect = settings.effect if with_effect else "none"
    factors = refinement(settings, with_effect=with_effect)
    size = tuple(f * (n - 1) + 1 for f, n in zip(factors, settings.grid, strict=True))
    fps = settings.fps * (1 + (values["error"] if effect == "frame_rate" else 0))
    displacement = pinned_displacement(settings, np.arange(settings.n_frames) / fps)
    if effect == "anchor_slip":
        displacement[:, 1] += slip(settings)
    request: dict[str, Any] = {
        "name": name,
        "pose": pose(settings, size).tolist(),
        "rest": rest(settings, size, values.get("curvature", 0.0)).tolist(),
        "pinned": [[0, 0], [size[0] - 1, 0]],
        "displacement": displacement.tolist(),
        "fps": fps,
        "steps": settings.steps,
        "gravity": true_gravity(settings).tolist() if with_effect else list(settings.gravity),
        "cloth": cloth_of(settings, size),
        "weights": {},
        "fields": [],
    }
    strength = float(np.linalg.norm(settings.wind))
    if strength > 0:
        request["fields"].append(_field("WIND", settings.wind, np.full(settings.n_frames, strength)))
    if effect == "air_drag":
        request["cloth"]["air_damping"] = values["air_damping"]
    elif effect == "internal_damping":
        for kind in ("shear", "bending", "tension", "compression"):
            ratio = values["axial_ratio"] if kind in ("tension", "compression") else 1
            request["cloth"][f"{kind}_damping"] = ratio * values["damping"]
    elif effect == "nonuniform_stiffness":
        weights = patch(settings, size).tolist()
        request["weights"] = {
            f"vertex_group_{kind}": weights for kind in ("structural_stiffness", "shear_stiffness", "bending")
        }
        for kind in ("tension", "compression", "shear", "bending"):
            factor = values["bend_factor" if kind == "bending" else "factor"]
            request["cloth"][f"{kind}_stiffness_max"] = factor * request["cloth"][f"{kind}_stiffness"]
    elif effect == "contact":
        assert twin is not None
        request["sphere"] = sphere(settings, twin)
    elif effect == "gusts":
        request["fields"].append(_field("WIND", gust_direction(settings), gust_strength(settings)))
    elif effect in ("vortex_field", "turbulence"):
        field = _field(
            "VORTEX" if effect == "vortex_field" else "TURBULENCE",
            settings.gravity,
            np.full(settings.n_frames, values["strength"]),
        )
        field["location"] = _middle(settings).tolist()
        if effect == "turbulence":
            field["attributes"] = {"size": values["size"]}
        request["fields"].append(field)
    elif effect == "internal_pressure":
        request["cloth"] |= {"use_pressure": True, "uniform_pressure_force": values["force"]}
    elif effect == "shrinking":
        request["shrinkage"] = np.linspace(0, values["fraction"], settings.n_frames).tolist()
    return request


def film(settings: BlenderSettings, vertices: Path, texture: Path) -> dict[str, Any]:
    """Request for the images of a motion (F, H', W', 3) [m] in a file, with a texture in another."""
    values, effect = settings.values, settings.effect
    height, width = settings.image_size
    request: dict[str, Any] = {
        "vertices": str(vertices),
        "texture": str(texture),
        "camera": {
            "fx": settings.focal_length * (1 + (values["error"] if effect == "focal_error" else 0)),
            "cx": width / 2,
            "cy": height / 2,
            "height": height,
            "width": width,
        },
        "samples": settings.samples,
        "filter_width": settings.filter_width,
        "seed": settings.seed,
        "shutter": values.get("shutter", 0.0),
        "exposures": int(values.get("exposures", 1)),
    }
    if effect == "shading":
        request["light"] = {
            "ambient": values["ambient"],
            "lambert": values["lambert"],
            "direction": light_directions(settings).tolist(),
        }
    elif effect == "occluder":
        request["occluder"] = _bar(settings)
    return request


def cloth_of(settings: BlenderSettings, size: tuple[int, ...]) -> dict[str, Any]:
    """Blender's cloth attributes for a grid of a size, so that it is the cloth of the reference grid.

    Blender divides the spring stiffness by the mean spring length L, so N/m per width ∝ stiffness / L; the
    mass is per vertex; the angular bending stiffness is per edge, and ½ k (κ L)² for each of ∝ 1/L² edges
    does not depend on L.
    """
    mean = 0.5 * sum(side / (n - 1) for side, n in zip(settings.cloth_size, size, strict=True))
    length = mean * (_REFERENCE - 1) / (0.5 * sum(settings.cloth_size))
    attributes: dict[str, Any] = {
        "mass": settings.mass * _REFERENCE**2 / (size[0] * size[1]),
        "tension_stiffness": settings.tension * length,
        "compression_stiffness": settings.tension * length,
        "shear_stiffness": settings.shear * length,
        "bending_stiffness": settings.bending,
        "air_damping": 0.0,
    }
    for kind in ("tension", "compression", "shear", "bending"):
        attributes[f"{kind}_damping"] = 0.0
    return attributes


def pose(settings: BlenderSettings, size: tuple[int, ...]) -> Array:
    """Frame 0 (*size, 3) [m]: a cylinder over a wavy line, isometric to the flat sheet, tilted and turned."""
    u, v = _sheet(settings, size)
    angle = math.radians(settings.bend_direction)
    along, across = u * math.cos(angle) + v * math.sin(angle), v * math.cos(angle) - u * math.sin(angle)
    line, height = _wave(settings, along)
    local = np.stack(
        (
            line * math.cos(angle) - across * math.sin(angle),
            line * math.sin(angle) + across * math.cos(angle),
            height,
        ),
        -1,
    )
    axes = _axes(settings)
    pinned = 0.5 * (local[0, 0] + local[-1, 0])
    turn = Rotation.from_euler("xy", [settings.pitch, settings.yaw], degrees=True)
    placed: Array = turn.apply((local - pinned).reshape(-1, 3)).reshape(local.shape) @ axes
    return placed + _top(settings)


def rest(settings: BlenderSettings, size: tuple[int, ...], curvature: float = 0.0) -> Array:
    """Rest shape (*size, 3) [m]: flat, or rolled about an axis along axis 0 by a curvature [1/m]."""
    u, v = _sheet(settings, size)
    if curvature == 0:
        return np.stack((u, v, np.zeros_like(u)), -1)
    return np.stack((u, np.sin(curvature * v) / curvature, (1 - np.cos(curvature * v)) / curvature), -1)


def pinned_displacement(settings: BlenderSettings, times: Array) -> Array:
    """Smooth random motion (T, 2, 3) [m] of the pinned corners at times (T,) [s]; at rest at time 0."""
    rng = settings.stream(1)
    common, difference = (_sway(rng, times, settings.motion_rate) for _ in range(2))
    size = settings.motion_amplitude * np.array([0.7, 0.5, 1.0])
    difference = settings.corner_difference * difference
    displacement: Array = np.stack((common + difference, common - difference), 1) * size
    return displacement


def slip(settings: BlenderSettings) -> Array:
    """Extra displacement (F, 3) [m] of the second pinned corner."""
    values = settings.values
    time = np.arange(settings.n_frames) / (settings.n_frames - 1)
    x = ((time - values["start"]) / max(values["duration"], 1e-9)).clip(0, 1)
    right, down, _ = _axes(settings)
    ramp: Array = values["distance"] * (x * x * (3 - 2 * x))[:, None] * (0.6 * down - 0.8 * right)
    return ramp


def true_gravity(settings: BlenderSettings) -> Array:
    """Gravity that acts [m/s²]."""
    angle = settings.values["angle"] if settings.effect == "gravity_tilt" else 0.0
    turned: Array = Rotation.from_euler("z", angle, degrees=True).apply(settings.gravity)
    return turned


def patch(settings: BlenderSettings, size: tuple[int, ...]) -> Array:
    """Weights (*size) in [0, 1] of the stiffer part: a smooth patch at a random place."""
    rng = np.random.default_rng([settings.seed, 2])
    centre = rng.uniform((0.25, 0.35), (0.75, 0.75))
    u, v = np.meshgrid(np.linspace(0, 1, size[0]), np.linspace(0, 1, size[1]), indexing="ij")
    distance = np.hypot(u - centre[0], v - centre[1]) / settings.values["width"]
    weights: Array = np.exp(-(distance**4))
    return weights


def gust_strength(settings: BlenderSettings) -> Array:
    """Strength (F,) of the gusts: two smooth swells, none at frame 0."""
    rng = settings.stream(3)
    time = np.arange(settings.n_frames) / (settings.n_frames - 1)
    total = np.zeros(settings.n_frames)
    for centre in (rng.uniform(0.2, 0.4), rng.uniform(0.6, 0.85)):
        width = rng.uniform(0.12, 0.2)
        inside = np.abs(time - centre) < width
        total += rng.uniform(0.7, 1) * inside * np.cos(0.5 * math.pi * (time - centre) / width) ** 2
    strength: Array = settings.values["strength"] * total
    strength[0] = 0
    return strength


def gust_direction(settings: BlenderSettings) -> Array:
    """Horizontal unit vector (3,), mostly towards or away from the camera."""
    rng = settings.stream(4)
    right, _, forward = _axes(settings)
    angle = rng.uniform(-0.9, 0.9)
    direction: Array = float(rng.choice((-1, 1))) * (math.cos(angle) * forward + math.sin(angle) * right)
    return direction


def light_directions(settings: BlenderSettings) -> Array:
    """Directions (F, 3) in which the sun's light travels: away from the camera and down, turning."""
    rng = np.random.default_rng([settings.seed, 5])
    sweep = math.radians(settings.values["sweep"]) * float(rng.choice((-1, 1)))
    height = math.radians(rng.uniform(25, 40))
    turn = rng.uniform(-0.2, 0.2) + sweep * (np.arange(settings.n_frames) / (settings.n_frames - 1) - 0.5)
    horizontal = np.stack((np.sin(turn), np.zeros_like(turn), np.cos(turn)), -1) * math.cos(height)
    directions: Array = horizontal + np.array([0, math.sin(height), 0])
    return directions


def sphere(settings: BlenderSettings, twin: Array) -> dict[str, Any]:
    """The sphere that the twin's motion (F, H', W', 3) would enter by the wanted depth.

    Raises:
        SimulationError: wherever it would be, it touches the cloth already in frame 0.
    """
    values = settings.values
    down = np.asarray(settings.gravity) / np.linalg.norm(settings.gravity)
    height, width = twin.shape[1:3]
    rng = settings.stream(6)
    lower = round((width - 1) * rng.uniform(0.65, 0.85))
    column = round((height - 1) * rng.uniform(0.3, 0.7))
    path = twin[:, column, lower]
    swing = path - path[0]
    swing = swing - np.outer(swing @ down, down)
    turning = int(np.linalg.norm(swing, axis=-1).argmax())
    ahead = swing[turning] / np.linalg.norm(swing[turning])
    thickness = 0.005
    centre = path[turning] + ahead * (values["radius"] - values["depth"])
    room = np.linalg.norm(twin[0] - centre, axis=-1).min() - values["radius"]
    if room < 3 * thickness:
        raise SimulationError(
            f"contact: the sphere would be {room:.3f} m from the cloth in frame 0; choose a smaller depth"
        )
    return {
        "centre": centre.tolist(),
        "radius": values["radius"],
        "friction": values["friction"],
        "thickness": thickness,
    }


def _bar(settings: BlenderSettings) -> dict[str, Any]:
    rng = settings.stream(7)
    values = settings.values
    right, down, _ = _axes(settings)
    slant = rng.uniform(-0.5, 0.5)
    time = np.arange(settings.n_frames) / (settings.n_frames - 1) - 0.5
    sign = float(rng.choice((-1, 1)))
    # Far enough in front for a swinging cloth not to reach it.
    nearness = 0.5
    return {
        "location": (_middle(settings) * (1 - nearness)).tolist(),
        "size": [values["width"] * (1 - nearness), values["width"] * (1 - nearness), 1.0],
        "direction": (math.cos(slant) * down + math.sin(slant) * right).tolist(),
        "colour": rng.uniform(0.1, 0.4, 3).tolist(),
        "shift": np.outer(sign * time * values["travel"] * (1 - nearness), right).tolist(),
    }


def _field(kind: str, direction: Any, strength: Array) -> dict[str, Any]:
    return {
        "type": kind,
        "location": [0.0, 0.0, 0.0],
        "direction": [float(x) for x in direction],
        "strength": strength.tolist(),
    }


def _sheet(settings: BlenderSettings, size: tuple[int, ...]) -> tuple[Array, Array]:
    """Flat coordinates u, v (*size) [m] from the middle of the sheet."""
    u, v = (
        np.linspace(-0.5 * side, 0.5 * side, n) for side, n in zip(settings.cloth_size, size, strict=True)
    )
    grid = np.meshgrid(u, v, indexing="ij")
    return grid[0], grid[1]


def _wave(settings: BlenderSettings, along: Array) -> tuple[Array, Array]:
    """A wavy line of unit speed at arc lengths: where it is along its axis and beside it, same shape [m]."""
    rng = settings.stream(8)
    reach = float(np.abs(along).max()) + 1e-9
    s = np.linspace(-reach, reach, 4001)
    phase = 2 * math.pi * settings.bend_waves * s / max(settings.cloth_size) + rng.uniform(0, 2 * math.pi)
    slope = math.radians(settings.bend) * np.sin(phase)
    step = s[1] - s[0]
    curves = []
    for rate in (np.cos(slope), np.sin(slope)):
        integral = cumulative_trapezoid(rate, dx=step, initial=0)
        curves.append(np.interp(along, s, integral - integral[len(s) // 2]))
    return curves[0], curves[1]


def _sway(rng: np.random.Generator, times: Array, rate: float = 1.0) -> Array:
    """Sum of slow sines (T, 3) of about unit size, zero and at rest at time 0."""
    x = (times / _FADE_IN).clip(0, 1)
    total = np.zeros((len(times), 3))
    for _ in range(3):
        frequency, phase = rate * rng.uniform(0.4, 1.1, 3), rng.uniform(0, 2 * math.pi, 3)
        total += rng.uniform(0.4, 0.8, 3) * (
            np.sin(2 * math.pi * frequency * times[:, None] + phase) - np.sin(phase)
        )
    return (x * x * (3 - 2 * x))[:, None] * total


def _axes(settings: BlenderSettings) -> Array:
    """Unit vectors right, down and forward as rows (3, 3): down along gravity, right in the image plane."""
    down = np.asarray(settings.gravity) / np.linalg.norm(settings.gravity)
    right = np.array([1.0, 0.0, 0.0])
    right = right - (right @ down) * down
    right /= np.linalg.norm(right)
    return np.stack((right, down, np.cross(right, down)))


def _top(settings: BlenderSettings) -> Array:
    """Middle of the pinned edge at frame 0 (3,) [m]."""
    return np.array([0.0, -0.47 * settings.cloth_size[1], settings.distance])


def _middle(settings: BlenderSettings) -> Array:
    """About the middle of the hanging cloth (3,) [m]."""
    return _top(settings) + 0.5 * settings.cloth_size[1] * _axes(settings)[1]
