"""Settings of a scene from Blender, and their random draw."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from toile.errors import InputError
from toile.generation.blender.effects import effect_named
from toile.generation.settings import wrong_setting

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class BlenderSettings:
    """Everything that a Blender scene follows from. Camera, gravity and frame rate are the declared ones.

    Material and wind are in Blender's own units; stiffnesses and mass are those of a 63 × 63 grid, and are
    converted so that another grid is the same cloth (``world.cloth_of``).

    Attributes:
        name: name of the scene.
        grid: grid (H, W) of the template and the ground truth, which a fit uses; H along the pinned edge.
        refinement: the simulated grid has refinement·(H-1)+1 by refinement·(W-1)+1 vertices.
        steps: of the solver per video frame, at least: more where balance.balanced asks for them.
        n_frames: number of frames F.
        fps: frames per second.
        cloth_size: sides along axis 0 and 1 [m].
        image_size: (height, width) [px].
        focal_length: [px]; the principal point is the middle of the image.
        gravity: [m/s²], camera frame.
        distance: z of the middle of the pinned edge at frame 0 [m].
        pitch, yaw: how far frame 0 leans back and is turned about gravity [degrees].
        bend: largest slope of the bend of frame 0 [degrees].
        bend_direction: direction along which it bends, from axis 0 to axis 1 [degrees].
        bend_waves: waves of the bend over the cloth.
        motion_amplitude: of the pinned corners [m], about.
        corner_difference: of their motions, as a fraction of it.
        wind: constant wind along the camera's axes, known to nobody [Blender's strength].
        mass: of a vertex [kg]; only its ratio to the stiffnesses matters.
        tension, shear, bending: stiffnesses; compression has that of tension.
        texture_size: side of the printed texture [px].
        samples: of Cycles per pixel.
        filter_width: of Cycles' pixel filter [px].
        noise: standard deviation of the image noise on the cloth, in [0, 1].
        seed: of texture, motion, noise and the effect's own pattern.
        clip: of a session: motion, pose, noise, gusts and obstacles follow from it and the seed; () for none.
        motion_rate: of the pinned corners, against their usual speed.
        effect: name of one of effects.EFFECTS.
        parameters: of the effect, where they differ from its defaults.
        python: interpreter that has bpy; None for the one of TOILE_BLENDER_PYTHON, else the running one.
        threads: of Blender.
    """

    name: str = "blender"
    grid: tuple[int, int] = (32, 32)
    refinement: int = 2
    steps: int = 15
    n_frames: int = 40
    fps: float = 25.0
    cloth_size: tuple[float, float] = (0.58, 0.58)
    image_size: tuple[int, int] = (540, 540)
    focal_length: float = 620.0
    gravity: Vector = (0.0, 9.81, 0.0)
    distance: float = 1.35
    pitch: float = 25.0
    yaw: float = 0.0
    bend: float = 12.0
    bend_direction: float = 20.0
    bend_waves: float = 0.6
    motion_amplitude: float = 0.04
    corner_difference: float = 0.25
    wind: Vector = (0.0, 0.0, 0.0)
    mass: float = 0.3
    tension: float = 30.0
    shear: float = 5.0
    bending: float = 0.5
    texture_size: int = 800
    samples: int = 8
    filter_width: float = 1.0
    noise: float = 0.005
    seed: int = 0
    clip: tuple[int, ...] = ()
    motion_rate: float = 1.0
    effect: str = "none"
    parameters: Mapping[str, float] = field(default_factory=dict)
    python: str | None = None
    threads: int = 1

    def __post_init__(self) -> None:
        for name in ("fps", "focal_length", "distance", "mass", "tension", "filter_width"):
            if not getattr(self, name) > 0:
                raise wrong_setting(name, "a number above 0", getattr(self, name))
        for name in ("shear", "bending", "noise", "motion_amplitude", "corner_difference"):
            if not getattr(self, name) >= 0:
                raise wrong_setting(name, "a number of at least 0", getattr(self, name))
        for name, least in (("refinement", 1), ("steps", 1), ("n_frames", 2), ("samples", 1), ("threads", 1)):
            if getattr(self, name) < least:
                raise wrong_setting(name, f"a whole number of at least {least}", getattr(self, name))
        if min(self.grid) < 3 or min(self.cloth_size) <= 0 or min(self.image_size) < 16:
            raise wrong_setting(
                "grid, cloth_size, image_size",
                "at least 3 × 3 vertices, positive sides, at least 16 × 16 px",
                (self.grid, self.cloth_size, self.image_size),
            )
        if not math.hypot(*self.gravity[1:]) > 0:
            raise wrong_setting("gravity", "a vector that is not along the camera's x axis", self.gravity)
        ratio = self.values.get("ratio", 1.0)
        if ratio < 1 or ratio != int(ratio):
            raise wrong_setting("parameters", "a ratio that is a whole number of at least 1", ratio)
        if not 0 <= self.values.get("shutter", 0.0) <= 1 or self.values.get("exposures", 1.0) < 1:
            raise wrong_setting("parameters", "a shutter in [0, 1], at least 1 exposure", self.values)

    def stream(self, purpose: int) -> np.random.Generator:
        """Random numbers for one purpose of this clip; of the whole session for one without clips."""
        return np.random.default_rng([self.seed, purpose, *self.clip])

    @property
    def values(self) -> dict[str, float]:
        """All parameters of the effect.

        Raises:
            InputError: no such effect, or a parameter that it does not have.
        """
        return effect_named(self.effect).values(self.parameters)


def random_settings(
    seed: int,
    effect: str = "none",
    parameters: Mapping[str, float] | None = None,
    *,
    name: str | None = None,
    small: bool = False,
    python: str | None = None,
) -> BlenderSettings:
    """A scene of the usual kind: cloth, pose, motion, camera, material and wind drawn at random.

    Draws do not depend on the effect, so the same seed with another effect is the same scene otherwise.

    Args:
        seed: the same seed gives the same settings.
        effect: see BlenderSettings.
        parameters: see BlenderSettings.
        name: of the scene; None for one that follows from the seed.
        small: a 24 × 24 grid and 300 px instead of 32 × 32 and 540 px.
        python: see BlenderSettings.

    Raises:
        InputError: no such effect, or a parameter that it does not have.
    """
    if seed < 0:
        raise InputError("Seed is negative", where="seed", expected="a number of at least 0", got=str(seed))
    rng = np.random.default_rng([seed, 0])
    side = round(float(rng.uniform(0.5, 0.65)), 3)
    tilt = math.radians(rng.uniform(-6, 6))
    pixels = 300 if small else 540
    pitch = float(rng.uniform(12, 34)) * float(rng.choice((-1, 1)))
    speed = float(rng.uniform(2000, 5000)) * float(rng.integers(0, 2))  # none in every other scene
    towards = rng.uniform(0, 2 * math.pi)
    across, along = math.cos(towards) * speed, math.sin(towards) * speed
    return BlenderSettings(
        name=name or f"blender-{seed}",
        grid=(24, 24) if small else (32, 32),
        cloth_size=(side, side),
        image_size=(pixels, pixels),
        focal_length=round(float(rng.uniform(590, 650)) * pixels / 540, 2),
        gravity=(0.0, round(9.81 * math.cos(tilt), 5), round(9.81 * math.sin(tilt), 5)),
        distance=2.35 * side,
        pitch=pitch,
        yaw=float(rng.uniform(-12, 12)),
        bend=float(rng.uniform(4, 16)),
        bend_direction=float(rng.uniform(-60, 60)),
        bend_waves=float(rng.uniform(0.3, 0.9)),
        motion_amplitude=float(rng.uniform(0.025, 0.045)),
        corner_difference=float(rng.uniform(0.15, 0.4)),
        wind=(across, -along * math.sin(tilt), along * math.cos(tilt)),
        tension=float(rng.uniform(15, 40)),
        shear=float(rng.uniform(3, 8)),
        bending=float(np.exp(rng.uniform(math.log(0.1), math.log(2.0)))),
        seed=seed,
        effect=effect,
        parameters=dict(parameters or {}),
        python=python,
    )
