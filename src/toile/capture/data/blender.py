"""Domains to test on: truth by Blender's cloth solver, images by Cycles, masks cut out of them.

``studio``: a green screen and several cameras, masks by chroma keying of the images. ``wild``: one camera, a
sun that moves and a background that moves; masks are Cycles' coverage, since there is nothing to key by.
"""

from __future__ import annotations

import tempfile
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
import torch

from toile.capture.data.clips import PlannedClip, Truth
from toile.capture.data.estimate import Estimate
from toile.capture.data.filming import Looks, TexturedPair, detected, view_of
from toile.capture.data.own import CaptureSettings, OwnDomain, Pattern
from toile.capture.garments.garment import attached_targets
from toile.capture.motion.source import MotionSource
from toile.generation.blender import process
from toile.generation.blender.exposure import srgb
from toile.generation.textures import procedural_texture
from toile.geometry.camera import Camera
from toile.limits import Count, NonNegative, Positive, Unit
from toile.physics.simulator import SimulationError
from toile.preparation.segmentation.cleaning import Cleaning
from toile.preparation.segmentation.dark_background import DarkBackground
from toile.rendering.base import Renderer
from toile.scenes.images import write_image, write_levels
from toile.scenes.views import MultiView

_FILM, _SUN = 1, 2  # purposes of random numbers
_GREEN = (40, 170, 60)
_SPACING = 0.0092  # m, of the 63 x 63 grid that mass and stiffness are given for (generation.blender)

Levels = npt.NDArray[np.uint8]
Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class BlenderCloth:
    """Blender's cloth solver, in its own units.

    Attributes:
        steps: per frame.
        mass: of a vertex of a grid of 9.2 mm; only its ratio to the stiffnesses matters.
        tension, shear, bending: stiffnesses.
        air: damping by the air.
        thickness: distance that is kept from the body [m].
        friction: with the body.
    """

    steps: Count = 15
    mass: Positive = 0.3
    tension: Positive = 30.0
    shear: NonNegative = 5.0
    bending: NonNegative = 0.5
    air: NonNegative = 1.0
    thickness: Annotated[Positive, Unit("m")] = 0.004
    friction: NonNegative = 5.0


@dataclass(frozen=True)
class Cycles:
    """Cycles, and the noise of the camera.

    Attributes:
        samples: per pixel.
        filter_width: of the pixel filter.
        noise: standard deviation, in [0, 1].
    """

    samples: Count = 8
    filter_width: Annotated[Positive, Unit("px")] = 1.0
    noise: NonNegative = 0.005


class Stage(ABC):
    """Where the person is filmed."""

    NAME: str

    @abstractmethod
    def cameras(self, ring: Sequence[Camera]) -> tuple[Camera, ...]:
        """Which of the ring's cameras film."""

    def dressed(self, texture: torch.Tensor) -> torch.Tensor:
        """What the person wears there, for the texture (h, w, 3) of somebody who may wear anything."""
        return texture

    @abstractmethod
    def sun(self, n_frames: int, rng: np.random.Generator) -> Floats:
        """Direction towards the sun in each frame (F, 3)."""

    @abstractmethod
    def compose(
        self, images: Sequence[Floats], noise: float, rng: np.random.Generator
    ) -> list[tuple[Levels, npt.NDArray[np.bool_]]]:
        """Frame (h, w, 3) and mask (h, w) of every image (h, w, 4), linear light times coverage."""


class Studio(Stage):
    """Green screen, still light, all cameras; masks by chroma keying."""

    NAME = "studio"

    def dressed(self, texture: torch.Tensor) -> torch.Tensor:
        """Nobody wears green before a green screen."""
        red, green, blue = texture.unbind(-1)
        return torch.stack((red, torch.minimum(green, torch.maximum(red, blue)), blue), -1)

    def cameras(self, ring: Sequence[Camera]) -> tuple[Camera, ...]:
        """See Stage."""
        return tuple(ring)

    def sun(self, n_frames: int, rng: np.random.Generator) -> Floats:
        """See Stage."""
        return np.repeat(_towards(rng.uniform(0, 2 * np.pi), 0.9)[None], n_frames, 0)

    def compose(
        self, images: Sequence[Floats], noise: float, rng: np.random.Generator
    ) -> list[tuple[Levels, npt.NDArray[np.bool_]]]:
        """See Stage."""
        # About half of what skin and cloth differ by: where the screen shines through by half.
        # Gaps between arm and body are gaps; only single pixels are filled.
        keying = DarkBackground(Cleaning(0.02, 0.002), threshold=48, background=_GREEN)
        screen = np.array(_GREEN) / 255
        found = []
        for number, image in enumerate(images):
            frame = _levels(_over(image, screen), noise, rng)
            found.append((frame, keying.cleaning(keying.segment(frame, number, None))))
        return found


class Wild(Stage):
    """One camera, light and background that move."""

    NAME = "wild"

    def cameras(self, ring: Sequence[Camera]) -> tuple[Camera, ...]:
        """See Stage."""
        return (ring[0],)

    def sun(self, n_frames: int, rng: np.random.Generator) -> Floats:
        """See Stage."""
        start, through = rng.uniform(0, 2 * np.pi), rng.uniform(0.5, 1.5)
        angles = start + np.linspace(0, through, n_frames)
        return np.stack([_towards(angle, 0.6 + 0.3 * np.sin(2 * angle)) for angle in angles])

    def compose(
        self, images: Sequence[Floats], noise: float, rng: np.random.Generator
    ) -> list[tuple[Levels, npt.NDArray[np.bool_]]]:
        """See Stage."""
        h, w = images[0].shape[:2]
        wall = procedural_texture(2 * h, 2 * w, int(rng.integers(2**31))).numpy().astype(float)
        found = []
        for number, image in enumerate(images):
            shift = round(number * w / max(1, len(images)))
            behind = wall[number % 2 : number % 2 + h, shift : shift + w]
            found.append((_levels(_over(image, behind), noise, rng), image[..., 3] > 0.5))
        return found


class BlenderDomain(OwnDomain):
    """Truth by Blender's cloth solver on the finer mesh, images by Cycles.

    Args:
        settings: see CaptureSettings; of its world only the finer mesh matters.
        garment: the model's garment.
        renderer: tells which pixels show the garment.
        stage: where it is filmed.
        cloth: see BlenderCloth.
        cycles: see Cycles.
        python: interpreter that has bpy; None for the one of TOILE_BLENDER_PYTHON, else the running one.
        threads: of Blender.
        motion: where the motions come from.
    """

    NAME = "blender"

    def __init__(
        self,
        settings: CaptureSettings,
        garment: Pattern,
        renderer: Renderer,
        stage: Stage,
        cloth: BlenderCloth,
        cycles: Cycles,
        python: str | None = None,
        threads: Count = 1,
        motion: MotionSource | None = None,
    ) -> None:
        super().__init__(settings, garment, renderer, motion)
        self.stage, self.cloth, self.cycles = stage, cloth, cycles
        self.python, self.threads = python, threads

    def cameras(self) -> tuple[Camera, ...]:
        """See OwnDomain; the stage may want fewer."""
        return self.stage.cameras(super().cameras())

    def estimate(self) -> Estimate:
        """See OwnDomain; steps are those of Blender, whose time is not known."""
        return replace(super().estimate(), substeps=self.cloth.steps, simulated=False)

    def describe(self) -> Mapping[str, Any]:
        """See Domain.

        Raises:
            InputError: no bpy, or what OwnDomain raises.
        """
        process.interpreter(self.python)
        common = {key: value for key, value in super().describe().items() if key != "membrane"}
        return {
            **common,
            "stage": self.stage.NAME,
            "cloth": asdict(self.cloth),
            "cycles": asdict(self.cycles),
        }

    def truth(self, plan: PlannedClip) -> Truth:
        """See Domain."""
        body, garment, cloth = self.body(plan), self.true_garment, self.cloth
        rest = garment.rest_vertices
        corners = rest[garment.faces]
        spacing = float((corners - corners.roll(1, 1)).norm(dim=-1).mean())
        with tempfile.TemporaryDirectory(prefix="toile-blender-") as scratch:
            work = Path(scratch)
            np.savez(
                work / "given.npz",
                body=body.numpy(),
                body_faces=self.subject.faces.numpy(),
                garment=rest.numpy(),
                garment_faces=garment.faces.numpy(),
                pinned=garment.attached.numpy(),
                targets=attached_targets(garment, body, self.subject.faces).numpy(),
            )
            simulation = {
                "arrays": str(work / "given.npz"),
                "fps": self.settings.fps,
                "steps": cloth.steps,
                "gravity": [0.0, -9.81, 0.0],
                "thickness": cloth.thickness,
                "friction": cloth.friction,
                "cloth": {
                    # A coarser mesh of the same cloth has heavier vertices on the same springs.
                    "mass": cloth.mass * (spacing / _SPACING) ** 2,
                    "tension_stiffness": cloth.tension,
                    "compression_stiffness": cloth.tension,
                    "shear_stiffness": cloth.shear,
                    "bending_stiffness": cloth.bending,
                    "air_damping": cloth.air,
                },
            }
            request = {"threads": self.threads, "simulation": simulation}
            process.run(request, work, self.python, process.PERSON_ENGINE)
            motion = np.load(work / "garment.npy").astype(np.float64)
        if not np.isfinite(motion).all() or np.ptp(motion, axis=1).max() > 5 * self.subject.height:
            raise SimulationError(f"{plan.folder}: Blender's cloth tears apart; take more steps")
        return self.truth_of(body, motion, {})

    def film(self, plan: PlannedClip, truth: Truth, folder: Path) -> MultiView:
        """See Domain."""
        rng = plan.stream(_FILM)
        looks = Looks.random(rng, self.settings.ring.side)
        looks = replace(looks, texture=self.stage.dressed(looks.texture))
        cameras = self.cameras()
        pair = TexturedPair(truth, looks)
        views = []
        with tempfile.TemporaryDirectory(prefix="toile-blender-") as scratch:
            work = Path(scratch)
            self._render(plan, truth, pair, looks, cameras, work)
            for number, camera in enumerate(cameras):
                label = f"camera{number}"
                place = folder / "views" / label
                place.mkdir(parents=True)
                images = [
                    np.load(work / f"image_{number}_{f:03d}.npy").astype(np.float64)
                    for f in range(truth.n_frames)
                ]
                for f, (frame, mask) in enumerate(self.stage.compose(images, self.cycles.noise, rng)):
                    write_levels(place / f"rgb_{f:03d}.png", frame)
                    write_image(place / f"mask_{f:03d}.png", torch.from_numpy(mask).float())
                    cloth = pair.draw(f, camera, self._renderer).garment
                    write_image(place / f"garment_mask_{f:03d}.png", cloth.float())
                marks = detected(truth.landmarks, camera, self.settings.noise, rng)
                np.save(place / "landmarks.npy", marks.numpy())
                views.append(view_of(label, camera, folder, truth.n_frames, marks))
        return MultiView(plan.folder, tuple(views), truth.fps, truth.landmark_names)

    def _render(
        self,
        plan: PlannedClip,
        truth: Truth,
        pair: TexturedPair,
        looks: Looks,
        cameras: Sequence[Camera],
        work: Path,
    ) -> None:
        write_image(work / "texture.png", looks.texture)
        everything = np.concatenate((truth.body_positions, truth.garment_positions), 1)
        uv = pair.uv.numpy().astype(float)
        np.savez(
            work / "mesh.npz",
            positions=everything[:, pair.vertices.numpy()],
            faces=pair.faces.numpy(),
            uv=np.stack((uv[:, 0], 1 - uv[:, 1]), 1),
        )
        film = {
            "meshes": [{"arrays": str(work / "mesh.npz"), "texture": str(work / "texture.png")}],
            "cameras": [
                {
                    "fx": c.fx,
                    "cx": c.cx,
                    "cy": c.cy,
                    "height": c.height,
                    "width": c.width,
                    "R": c.R.tolist(),
                    "t": c.t.tolist(),
                }
                for c in cameras
            ],
            "samples": self.cycles.samples,
            "filter_width": self.cycles.filter_width,
            "seed": self.settings.seed,
            "sun": self.stage.sun(truth.n_frames, plan.stream(_SUN)).tolist(),
            "strength": 0.6,
            "ambient": 0.4,
        }
        process.run({"threads": self.threads, "film": film}, work, self.python, process.PERSON_ENGINE)


def _towards(angle: float, height: float) -> Floats:
    return np.array([np.cos(angle) * np.cos(height), np.sin(height), np.sin(angle) * np.cos(height)])


def _over(image: Floats, background: Floats) -> Floats:
    """An image (h, w, 4) of linear light times coverage over a background that is encoded for the screen."""
    cover = image[..., 3:].clip(0, 1)
    own = image[..., :3] / np.where(cover > 0, cover, 1.0)
    shown: Floats = srgb(own) * cover + background * (1 - cover)
    return shown


def _levels(frame: Floats, noise: float, rng: np.random.Generator) -> Levels:
    noisy = frame + noise * rng.standard_normal(frame.shape)
    levels: Levels = (noisy.clip(0, 1) * 255).round().astype(np.uint8)
    return levels
