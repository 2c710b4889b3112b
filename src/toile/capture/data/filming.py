"""Images, masks and 2D landmarks of a moving body and garment, by our renderer."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from toile.capture.data.clips import Floats, Indices, Truth
from toile.generation.textures import procedural_texture
from toile.geometry.camera import Camera, looking_at
from toile.geometry.mesh import vertex_normals
from toile.limits import Count, Fraction, NonNegative, Positive, TwoOrMore, Unit
from toile.rendering.base import Renderer
from toile.scenes.images import write_image
from toile.scenes.native_views import view_files
from toile.scenes.views import MultiView, View

UP = torch.tensor([0.0, 1.0, 0.0])
_SKIN = (0.80, 0.62, 0.52)


@dataclass(frozen=True)
class CameraRing:
    """Cameras around the person, all looking at the middle of the body.

    Attributes:
        views: how many.
        side: of the square images.
        distance: from the person's axis.
        height: above the floor.
        target: height of the point that they look at.
        field_of_view: of the whole image.
    """

    views: Count = 4
    side: Annotated[TwoOrMore, Unit("px")] = 128
    distance: Annotated[Positive, Unit("m")] = 3.0
    height: Annotated[Positive, Unit("m")] = 1.1
    target: Annotated[Positive, Unit("m")] = 0.9
    field_of_view: Annotated[Positive, Unit("degrees")] = 40.0

    def cameras(self) -> tuple[Camera, ...]:
        """The cameras, the first in front of the person, the others counter-clockwise from above."""
        f = 0.5 * self.side / math.tan(math.radians(self.field_of_view) / 2)
        plain = Camera(f, f, self.side / 2, self.side / 2, self.side, self.side)
        target = torch.tensor([0.0, self.target, 0.0])
        found = []
        for k in range(self.views):
            angle = 2 * math.pi * k / self.views
            at = (self.distance * math.sin(angle), self.height, self.distance * math.cos(angle))
            found.append(looking_at(plain, torch.tensor(at, dtype=torch.float64), target, UP))
        return tuple(found)


@dataclass(frozen=True)
class LandmarkNoise:
    """How wrong detected landmarks are.

    Attributes:
        deviation: of the noise, in a thousandth of the image's side.
        lost: share of the landmarks that are not detected.
    """

    deviation: NonNegative = 5.0
    lost: Fraction = 0.02


@dataclass(frozen=True)
class Looks:
    """How a clip looks.

    Attributes:
        texture: of body (left) and garment (right), (s, 2 s, 3).
        light: direction towards it (3,), unit.
        ambient: share of the light that comes from everywhere.
        background: colour (3,) of the middle of the background.
    """

    texture: Tensor
    light: Tensor
    ambient: float
    background: tuple[float, float, float]

    @classmethod
    def random(cls, rng: np.random.Generator, side: int) -> Looks:
        """Other cloth, light and background; textures of that side [px], which images should resolve."""
        seeds = rng.integers(2**31, size=2)
        body, garment = (procedural_texture(side, side, int(seed)) for seed in seeds)
        body = 0.75 * torch.tensor(_SKIN) + 0.25 * body
        angle, height = rng.uniform(0, 2 * math.pi), rng.uniform(0.5, 1.2)
        light = torch.tensor(
            [math.cos(angle) * math.cos(height), math.sin(height), math.sin(angle) * math.cos(height)]
        )
        r, g, b = rng.uniform(0.2, 0.7, 3)
        return cls(torch.cat((body, garment), 1), light, float(rng.uniform(0.45, 0.65)), (r, g, b))


@dataclass(frozen=True)
class Picture:
    """One image of a person.

    Attributes:
        rgb: (h, w, 3) in [0, 1], black where nothing is.
        person: coverage by body and garment (h, w) in [0, 1].
        garment: pixels whose centre shows the garment (h, w), bool.
    """

    rgb: Tensor
    person: Tensor
    garment: Tensor


class TexturedPair:
    """Body and garment of a clip as one textured mesh.

    Args:
        truth: their motion.
        looks: textures and light.

    Attributes:
        vertices: (V',) which vertex of the body, then of the garment (from V on), each of its own is.
        faces: (T, 3) of those.
        uv: (V', 2).
    """

    def __init__(self, truth: Truth, looks: Looks) -> None:
        moving = (
            (truth.body_positions, truth.body_faces),
            (truth.garment_positions, truth.garment_faces),
        )
        parts = [Unrolled.of(x[0], faces) for x, faces in moving]
        self._surfaces = [
            (np.ascontiguousarray(x), torch.from_numpy(np.ascontiguousarray(faces)), part.vertices)
            for (x, faces), part in zip(moving, parts, strict=True)
        ]
        self.faces = torch.cat((parts[0].faces, parts[1].faces + len(parts[0].vertices)))
        self._n_body = len(parts[0].faces)
        self.vertices = torch.cat((parts[0].vertices, parts[1].vertices + truth.body_positions.shape[1]))
        # Half the picture each, with a margin that keeps the two from bleeding into each other.
        self.uv = torch.cat((squeezed(parts[0].uv, 0.0), squeezed(parts[1].uv, 0.5))).float()
        self._looks = looks

    def draw(self, f: int, camera: Camera, renderer: Renderer) -> Picture:
        """Frame f."""
        shown = [(torch.from_numpy(x[f]), faces, index) for x, faces, index in self._surfaces]
        positions = torch.cat([x[index] for x, _, index in shown])[None]
        normals = torch.cat([vertex_normals(x, faces)[index] for x, faces, index in shown])
        image = renderer.render(positions, self.faces, self.uv, self._looks.texture, camera)
        hit = renderer.rasterize(positions, self.faces, camera)
        seen = hit.face[0] >= 0
        corners = self.faces[hit.face[0].clamp(min=0)]
        normal = (normals[corners] * hit.barycentrics[0][..., None].double()).sum(-2)
        light = torch.where(seen, _shade(normal, camera, self._looks), 1.0)
        rgb = image.rgb[0] * light[..., None].float()
        return Picture(rgb, image.silhouette[0], seen & (hit.face[0] >= self._n_body))


def film(
    truth: Truth,
    cameras: tuple[Camera, ...],
    looks: Looks,
    noise: LandmarkNoise,
    rng: np.random.Generator,
    renderer: Renderer,
    folder: Path,
    name: str,
) -> MultiView:
    """Write images, masks of person and garment, and landmarks of every view.

    Args:
        truth: what moves.
        cameras: with poses.
        looks: textures, light, background.
        noise: of the landmarks.
        rng: of that noise and the background.
        renderer: any renderer.
        folder: of the clip; files go to ``views/<camera>/``.
        name: of the recording.
    """
    model = TexturedPair(truth, looks)
    views = []
    for k, camera in enumerate(cameras):
        label = f"camera{k}"
        place = folder / "views" / label
        place.mkdir(parents=True)
        background = _background(camera, looks.background, rng)
        for f in range(truth.n_frames):
            picture = model.draw(f, camera, renderer)
            rgb = picture.rgb + (1 - picture.person)[..., None] * background
            write_image(place / f"rgb_{f:03d}.png", rgb)
            write_image(place / f"mask_{f:03d}.png", picture.person)
            write_image(place / f"garment_mask_{f:03d}.png", picture.garment.float())
        marks = detected(truth.landmarks, camera, noise, rng)
        np.save(place / "landmarks.npy", marks.numpy())
        views.append(view_of(label, camera, folder, truth.n_frames, marks))
    return MultiView(name, tuple(views), truth.fps, truth.landmark_names)


def drawn(
    truth: Truth,
    camera: Camera,
    looks: Looks,
    renderer: Renderer,
    frames: Sequence[int],
    behind: Sequence[npt.NDArray[np.floating]] | None = None,
) -> list[npt.NDArray[np.uint8]]:
    """Pictures (h, w, 3), uint8, of some frames, e.g. from where no camera stood.

    Args:
        truth: what moves.
        camera: with its pose.
        looks: textures and light.
        renderer: any renderer.
        frames: numbers of the frames.
        behind: a picture (h, w, 3) in [0, 1] for each of them; a grey wall if None.
    """
    model = TexturedPair(truth, looks)
    found = []
    for k, f in enumerate(frames):
        picture = model.draw(f, camera, renderer)
        wall = torch.tensor(0.93) if behind is None else torch.from_numpy(np.asarray(behind[k], np.float32))
        rgb = picture.rgb + (1 - picture.person)[..., None] * wall
        found.append((255 * rgb.clamp(0, 1)).round().byte().numpy())
    return found


def looking_from(camera: Camera, angle: float) -> Camera:
    """A camera turned about the world's vertical axis, with what it looks at.

    Args:
        camera: with its pose.
        angle: [rad], counter-clockwise from above.
    """
    c, s = math.cos(angle), math.sin(angle)
    turn = torch.tensor([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]], dtype=torch.float64)
    return camera.with_pose(camera.R @ turn.T, camera.t)


def detected(landmarks: Floats, camera: Camera, noise: LandmarkNoise, rng: np.random.Generator) -> Tensor:
    """What a detector would find of landmarks (F, L, 3) [m]: (F, L, 3), float32, x, y [px], confidence."""
    exact = camera.project(torch.from_numpy(landmarks))
    moved = exact + 1e-3 * noise.deviation * camera.width * torch.from_numpy(rng.standard_normal(exact.shape))
    inside = (moved >= 0) & (moved < torch.tensor([camera.width, camera.height]))
    kept = inside.all(-1) & torch.from_numpy(rng.random(moved.shape[:-1]) >= noise.lost)
    kept &= camera.from_world(torch.from_numpy(landmarks))[..., 2] > 0
    confidence = kept * (0.6 + 0.4 * torch.from_numpy(rng.random(moved.shape[:-1])))
    return torch.cat((torch.where(kept[..., None], moved, 0.0), confidence[..., None]), -1).float()


def view_of(label: str, camera: Camera, folder: Path, n: int, marks: Tensor) -> View:
    """The view whose n frames, masks and garment masks are written to ``views/<label>/``."""
    nothing = View(label, camera, (Path("x.png"),), (Path("x.png"),), (Path("x.png"),), marks)
    files = view_files(nothing, f"views/{label}")
    rgb, mask, cloth = (
        tuple(folder / (files[key] % f) for f in range(n)) for key in ("rgb", "mask", "garment_mask")
    )
    return View(label, camera, rgb, mask, cloth, marks)


def _shade(normal: Tensor, camera: Camera, looks: Looks) -> Tensor:
    """Lambert's law on the side of the surface that the camera sees."""
    # A pixel's ray differs little from the axis; the side is told by the sign alone.
    towards = -camera.R[2]
    turned = torch.where((normal @ towards)[..., None] < 0, -normal, normal)
    cosine = (torch.nn.functional.normalize(turned, dim=-1) @ looks.light.double()).clamp(min=0)
    return looks.ambient + (1 - looks.ambient) * cosine


def _background(camera: Camera, colour: tuple[float, float, float], rng: np.random.Generator) -> Tensor:
    """Smooth (h, w, 3)."""
    coarse = torch.from_numpy(rng.uniform(-0.2, 0.2, (1, 3, 4, 4)))
    smooth = torch.nn.functional.interpolate(
        coarse, (camera.height, camera.width), mode="bicubic", align_corners=True
    )
    return (smooth[0].permute(1, 2, 0) + torch.tensor(colour, dtype=torch.float64)).clamp(0, 1).float()


def squeezed(uv: Tensor, start: float) -> Tensor:
    """Texture coordinates within the half of a picture that begins at u = ``start``."""
    return torch.stack((start + 0.01 + 0.48 * uv[:, 0], uv[:, 1]), -1)


@dataclass(frozen=True)
class Unrolled:
    """A surface cut open behind, so that it has texture coordinates without a jump.

    Attributes:
        vertices: (V',) which vertex each of its own is a copy of.
        faces: (T, 3) of those.
        uv: (V', 2) in [0, 1].
    """

    vertices: Tensor
    faces: Tensor
    uv: Tensor

    @classmethod
    def of(cls, positions: Floats, faces: Indices) -> Unrolled:
        """Around the vertical axis through the middle."""
        centre = positions.mean(0)
        angle = np.arctan2(positions[:, 0] - centre[0], positions[:, 2] - centre[2])
        turned = angle[faces]
        across = np.ptp(turned, axis=1) > np.pi
        # Corners left of the cut in a face that crosses it get a copy one turn on.
        copied = across[:, None] & (turned < 0)
        originals = np.unique(faces[copied])
        number = np.full(len(positions), -1)
        number[originals] = len(positions) + np.arange(len(originals))
        cut = np.where(copied, number[faces], faces)
        vertices = np.concatenate((np.arange(len(positions)), originals))
        unrolled = np.concatenate((angle, angle[originals] + 2 * np.pi))
        height = positions[vertices, 1]
        low, high = height.min(), height.max()
        u = (unrolled + np.pi) / (3 * np.pi)
        v = (high - height) / max(high - low, 1e-9)
        return cls(
            torch.from_numpy(vertices),
            torch.from_numpy(cut.astype(np.int64)),
            torch.from_numpy(np.stack((u, v), 1)),
        )
