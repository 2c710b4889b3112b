"""The domain that training is done on: truth by our layer on a finer mesh, images by our renderer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
import torch
from pydantic import Field

from toile.capture.body.skinning import skin
from toile.capture.body.subject import Subject, load_subject
from toile.capture.data.clips import Domain, Floats, PlannedClip, Truth
from toile.capture.data.estimate import Estimate
from toile.capture.data.filming import CameraRing, LandmarkNoise, Looks, film
from toile.capture.garments.embedding import embed
from toile.capture.garments.garment import Garment, face_frames
from toile.capture.garments.own_mesh import OwnMesh
from toile.capture.garments.patterns import DressPattern, SkirtPattern
from toile.capture.layer.layer import SimulationLayer
from toile.capture.motion.source import MotionSource, ProceduralMotions
from toile.effects.air_drag import AirDrag
from toile.errors import InputError
from toile.geometry.camera import Camera
from toile.limits import Count, Fraction, NonNegative, Positive, Seed, TwoOrMore, Unit
from toile.physics.energies.membrane import Membrane, StVenantKirchhoff
from toile.physics.simulator import SimulationError
from toile.rendering.base import Renderer
from toile.scenes.views import MultiView

Pattern = SkirtPattern | DressPattern | OwnMesh
_MOTION, _FILM = 0, 1  # purposes of random numbers


@dataclass(frozen=True)
class TrueWorld:
    """How the truth differs from the model that will be fitted to it.

    Attributes:
        vertices: of the garment's finer mesh, against those of the model.
        substeps: steps per frame.
        stiffness: of membrane and bending, against those of the model.
        friction: coefficient between cloth and body.
        drag: of still air, in every direction.
        drag_across: of still air, across the cloth.
        least_converged: share of the steps that must converge.
    """

    vertices: Positive = 1.6
    substeps: Count = 6
    stiffness: Positive = 1.3
    friction: NonNegative = 0.4
    drag: Annotated[NonNegative, Unit("1/s")] = 0.3
    drag_across: Annotated[NonNegative, Unit("1/s")] = 1.0
    least_converged: Fraction = 0.98


@dataclass(frozen=True)
class CaptureSettings:
    """What a data set follows from.

    Attributes:
        subject: name or file.
        motions: names, one clip each.
        repetitions: how often the motions are made, with other random numbers.
        n_frames: of a clip.
        fps: frames per second.
        world: see TrueWorld.
        ring: see CameraRing.
        noise: see LandmarkNoise.
        seed: of everything.
    """

    subject: str = "default"
    motions: Annotated[Sequence[str], Field(min_length=1)] = ("walk", "twirl")
    repetitions: Count = 1
    n_frames: TwoOrMore = 40
    fps: Annotated[Positive, Unit("1/s")] = 30.0
    world: TrueWorld = field(default_factory=TrueWorld)
    ring: CameraRing = field(default_factory=CameraRing)
    noise: LandmarkNoise = field(default_factory=LandmarkNoise)
    seed: Seed = 0


class OwnDomain(Domain):
    """Truth by our layer on a finer mesh with another material law, images by our renderer.

    Args:
        settings: see CaptureSettings.
        garment: the model's garment, made for the subject.
        renderer: draws the images.
        motion: where the motions come from.

    Raises:
        InputError: a motion that is none.
    """

    NAME = "own"
    LAW: ClassVar[type[Membrane]] = StVenantKirchhoff
    """Law of in-plane strain of the truth; the model's is another one."""

    def __init__(
        self,
        settings: CaptureSettings,
        garment: Pattern,
        renderer: Renderer,
        motion: MotionSource | None = None,
    ) -> None:
        self.motion = ProceduralMotions() if motion is None else motion
        unknown = [name for name in settings.motions if name not in self.motion.names]
        if unknown:
            raise InputError(
                "Unknown motion",
                where="settings.motions",
                expected=", ".join(self.motion.names),
                got=", ".join(unknown),
            )
        self.settings = settings
        self.pattern = garment
        self._renderer = renderer

    def describe(self) -> Mapping[str, Any]:
        """See Domain.

        Raises:
            InputError: no such subject, no garment of this kind that fits, or no such motion.
        """
        # Whatever is wrong with them is said before anything is written.
        _ = self.garment, self.true_garment
        of_motion, s = self.motion.describe(), self.settings
        for name in dict.fromkeys(s.motions):
            self.motion.poses(self.subject, name, s.n_frames, s.fps, s.seed)
        kind = type(self.pattern).__name__.removesuffix("Pattern").lower()
        return {
            "domain": self.NAME,
            "settings": asdict(self.settings),
            "garment": {"kind": kind, **asdict(self.pattern)},
            "membrane": self.LAW.__name__,
            **self._digests(),
            **of_motion,
        }

    def _digests(self) -> dict[str, str]:
        """What is in the files that a set follows from: another mesh of that name is another garment."""
        files = {"garment_file": getattr(self.pattern, "file", None), "subject_file": self.settings.subject}
        return {
            name: sha256(Path(file).read_bytes()).hexdigest()
            for name, file in files.items()
            if file is not None and Path(file).is_file()
        }

    def estimate(self) -> Estimate:
        """What the set will be and take.

        Raises:
            InputError: see ``describe``.
        """
        self.describe()
        s = self.settings
        return Estimate(
            clips=len(self.plans()),
            frames=s.n_frames,
            views=len(self.cameras()),
            side=s.ring.side,
            substeps=s.world.substeps,
            body_vertices=len(self.subject.rest_vertices),
            garment_vertices=len(self.garment.rest_vertices),
            true_vertices=len(self.true_garment.rest_vertices),
        )

    def cameras(self) -> tuple[Camera, ...]:
        """Those that watch."""
        return self.settings.ring.cameras()

    def plans(self) -> Sequence[PlannedClip]:
        """See Domain."""
        names = [name for _ in range(self.settings.repetitions) for name in self.settings.motions]
        return [PlannedClip(k, name, self.settings.seed) for k, name in enumerate(names)]

    @cached_property
    def subject(self) -> Subject:
        """Who moves."""
        return load_subject(self.settings.subject)

    @cached_property
    def garment(self) -> Garment:
        """The model's garment."""
        return self.pattern.make(self.subject)

    @cached_property
    def true_garment(self) -> Garment:
        """The finer garment of the truth."""
        world, finer = self.settings.world, self.pattern
        if isinstance(finer, OwnMesh):
            if world.vertices != 1:
                raise InputError(
                    "A mesh of one's own has no finer version",
                    where="settings.world.vertices",
                    expected="1, with garment=mesh",
                    got=f"{world.vertices:g}",
                )
        else:
            finer = replace(finer, vertices=round(finer.vertices * world.vertices))
        made = finer.make(self.subject)
        material = replace(
            made.material,
            young=made.material.young * world.stiffness,
            bending=made.material.bending * world.stiffness,
            friction=world.friction,
        )
        return replace(made, material=material)

    def share(self, folder: Path) -> None:
        """See Domain."""
        for name, content in (
            ("subject.npz", self.subject),
            ("garment.npz", self.garment),
            ("true_garment.npz", self.true_garment),
        ):
            if not (folder / name).is_file():
                content.save(folder / name)

    def body(self, plan: PlannedClip) -> torch.Tensor:
        """Vertices of the body (F, V, 3) [m]."""
        s = self.settings
        seed = int(plan.stream(_MOTION).integers(2**31))
        return skin(self.subject, self.motion.poses(self.subject, plan.motion, s.n_frames, s.fps, seed))

    def truth(self, plan: PlannedClip) -> Truth:
        """See Domain."""
        s, world, garment = self.settings, self.settings.world, self.true_garment
        body = self.body(plan)
        drag = AirDrag({"linear": world.drag, "normal": world.drag_across})
        layer = SimulationLayer.of(garment, self.subject, membrane=self.LAW, terms=(drag,))
        motion = layer.simulate(body, s.fps, world.substeps)
        converged = float(motion.converged.mean())
        if converged < world.least_converged:
            raise SimulationError(
                f"{plan.folder}: {100 * converged:.1f} % of the steps of the truth converged, "
                f"{100 * world.least_converged:g} % asked for"
            )
        extra = {"converged": motion.converged, "membrane": np.array(self.LAW.__name__)}
        return self.truth_of(body, motion.garment_positions, extra)

    def truth_of(self, body: torch.Tensor, garment: Floats, extra: Mapping[str, Any]) -> Truth:
        """The truth of a motion of the finer garment; the model's vertices are carried along by its faces."""
        return Truth(
            body_positions=body.numpy(),
            body_faces=self.subject.faces.numpy(),
            garment_positions=garment,
            garment_faces=self.true_garment.faces.numpy(),
            fps=self.settings.fps,
            landmarks=self.subject.landmarks(body).numpy(),
            landmark_names=self.subject.landmark_names,
            extra={
                **extra,
                "model_positions": self._carried(garment).astype(np.float32),
                "model_faces": self.garment.faces.numpy().astype(np.int32),
            },
        )

    def film(self, plan: PlannedClip, truth: Truth, folder: Path) -> MultiView:
        """See Domain."""
        rng = plan.stream(_FILM)
        looks = Looks.random(rng, self.settings.ring.side)
        cameras = self.cameras()
        return film(truth, cameras, looks, self.settings.noise, rng, self._renderer, folder, plan.folder)

    def _carried(self, motion: Floats) -> Floats:
        """Vertices of the model (F, M, 3) where the finer garment takes them."""
        fine = self.true_garment
        place = embed(self.garment.rest_vertices, fine.rest_vertices, fine.faces)
        x = torch.from_numpy(motion)
        corners = fine.faces[place.faces]
        base = (x[:, corners] * place.barycentric[..., None]).sum(-2)
        moved = base + (face_frames(x, corners) @ place.offsets[..., None])[..., 0]
        return moved.numpy()
