"""All that is measured of a reconstructed person in a garment, against what is known to be true.

Where a person is in depth follows from one camera only by its size, so every measure that minds it is there
twice: with the translation as it was found, and with the true one, as Li et al. (3DV 2021, section 4.1) have
it for all methods. The true one is a shift of every frame that puts the middle of the hips where it truly is.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from toile.capture.body.subject import Subject
from toile.capture.data.clips import TRUTH_FILE, Floats, Truth
from toile.capture.garments.garment import Garment
from toile.capture.metrics.out_of_balance import TOUCHING, Touching, balance_with_contact
from toile.errors import InputError
from toile.evaluation.penetration import penetration
from toile.evaluation.vertices import vertex_distances
from toile.evaluation.view_silhouettes import ViewOverlap, overlap_in_views
from toile.geometry.camera import Camera
from toile.physics.cloth import Cloth, mesh_cloth
from toile.physics.energies.membrane import NeoHookean
from toile.rendering.base import Renderer
from toile.rendering.visibility import visible_points
from toile.scenes.multi_view import load_multi_view
from toile.scenes.views import MultiView

HIPS = ("left_hip", "right_hip")
"""Landmarks whose middle tells the true translation."""
_TOLERANCE = 5e-3  # depth within which a vertex lies on the surface that its pixel shows [m]


@dataclass(frozen=True)
class Measures:
    """Measures of one reconstruction; NaN where there is none, e.g. of other views where there is one camera.

    Forces in weights of a vertex, lengths in millimetres, overlaps from 0 to 1. MPJPE is the mean distance of
    the 3D landmarks. Errors of vertices are those of the model's garment, visible ones those that the input
    view shows in truth. ``penetration_mean_mm`` is the mean over penetrating vertices, as in the paper.
    """

    out_of_balance_avg: float
    out_of_balance_max: float
    penetration_mean_mm: float
    penetration_max_mm: float
    iou_all: float
    iou_reference: float
    iou_single: float
    mpjpe_mm: float
    vertex_error_mm: float
    vertex_error_visible_mm: float
    vertex_error_hidden_mm: float
    penetration_share: float
    body_penetration_max_mm: float
    out_of_balance_avg_true_translation: float
    out_of_balance_max_true_translation: float
    iou_all_true_translation: float
    iou_reference_true_translation: float
    iou_single_true_translation: float
    mpjpe_true_translation_mm: float
    vertex_error_true_translation_mm: float
    vertex_error_visible_true_translation_mm: float
    vertex_error_hidden_true_translation_mm: float

    def to_dict(self) -> dict[str, float | None]:
        """As JSON values; None where there is none."""
        return {k: v if math.isfinite(v) else None for k, v in asdict(self).items()}

    @classmethod
    def from_dict(cls, values: Mapping[str, float | None]) -> Measures:
        """Inverse of to_dict."""
        return cls(**{k: math.nan if v is None else float(v) for k, v in values.items()})


def combined(several: Sequence[Measures]) -> Measures:
    """Of several clips: the largest of maxima, the mean of all else; clips without a value left out."""
    found = {}
    for field in fields(Measures):
        values = [getattr(m, field.name) for m in several]
        known = [v for v in values if math.isfinite(v)]
        take = max if "_max" in field.name else _mean
        found[field.name] = take(known) if known else math.nan
    return Measures(**found)


def _mean(values: Sequence[float]) -> float:
    return math.fsum(values) / len(values)


@dataclass(frozen=True)
class Reconstruction:
    """What a method says about a clip.

    Attributes:
        garment: (F, N, 3) [m] in the world.
        body: (F, V, 3) [m].
        landmarks: (F, L, 3) [m], the subject's.
    """

    garment: Floats
    body: Floats
    landmarks: Floats

    def shifted(self, by: Floats) -> Reconstruction:
        """Every frame moved by (F, 3) [m]."""
        s = by[:, None]
        return Reconstruction(self.garment + s, self.body + s, self.landmarks + s)


class MeasuredClip:
    """A clip whose truth is known, ready to measure reconstructions of it.

    Args:
        truth: with ``model_positions`` of the garment that is reconstructed.
        recording: its cameras and masks.
        subject: whose body.
        garment: the model's.
        renderer: draws silhouettes.
        input_view: number of the camera that is reconstructed from.
        every: silhouettes are compared in every so many frames.

    Raises:
        InputError: truth of another garment or body, or no such camera.
    """

    def __init__(
        self,
        truth: Truth,
        recording: MultiView,
        subject: Subject,
        garment: Garment,
        renderer: Renderer,
        input_view: int = 0,
        every: int = 1,
    ) -> None:
        model = truth.extra.get("model_positions")
        if model is None or model.shape[1] != len(garment.rest_vertices):
            raise InputError(
                "Clip has no truth for this garment",
                where="truth: model_positions",
                expected=f"{len(garment.rest_vertices)} vertices",
                got="none" if model is None else str(model.shape[1]),
            )
        if not 0 <= input_view < len(recording.views):
            raise InputError(
                "No such view",
                where="view",
                expected=f"a camera from 0 to {len(recording.views) - 1}",
                got=str(input_view),
            )
        self.truth, self.recording = truth, recording
        self.subject, self.garment = subject, garment
        self.true_garment = model.astype(np.float64)
        self.input_view = input_view
        self._renderer, self._frames = renderer, list(range(0, truth.n_frames, every))

    @classmethod
    def load(cls, clip: Path, renderer: Renderer, input_view: int = 0, every: int = 1) -> MeasuredClip:
        """A clip of a data set, with the subject and the garment that lie beside it.

        Raises:
            InputError: something is missing, or does not fit.
        """
        return cls(
            Truth.load(clip / TRUTH_FILE),
            load_multi_view(clip),
            Subject.load(clip.parent / "subject.npz"),
            Garment.load(clip.parent / "garment.npz"),
            renderer,
            input_view,
            every,
        )

    @cached_property
    def cloth(self) -> Cloth:
        """The garment as the model of the simulation layer has it."""
        return mesh_cloth(
            self.garment.rest_vertices,
            self.garment.faces,
            self.garment.material.density,
            tuple(self.garment.attached.tolist()),
            NeoHookean,
            flat=True,
        )

    @cached_property
    def faces(self) -> Tensor:
        """Of body and model's garment together."""
        return torch.cat((self.subject.faces, self.garment.faces + len(self.subject.rest_vertices)))

    @cached_property
    def visible(self) -> Tensor:
        """Vertices of the true garment that the input view shows (F, N), bool."""
        camera = self.recording.cameras[self.input_view]
        positions = torch.from_numpy(np.concatenate((self.truth.body_positions, self.true_garment), 1))
        n = len(self.garment.rest_vertices)
        # Any face of a vertex; a vertex without one is nowhere.
        face = torch.zeros(n, dtype=torch.int64)
        corner = torch.zeros(n, 3, dtype=torch.float64)
        for k in range(3):
            own = self.garment.faces[:, k]
            face[own] = len(self.subject.faces) + torch.arange(len(own))
            corner[own] = torch.eye(3, dtype=torch.float64)[k]
        shown = []
        for x in positions:
            hit = self._renderer.rasterize(x[None], self.faces, camera)
            shown.append(visible_points(hit, x[None], self.faces, camera, face, corner, _TOLERANCE)[0])
        return torch.stack(shown)

    @cached_property
    def masks(self) -> list[Tensor]:
        """Of every view (F', h, w), of the frames that silhouettes are compared in."""
        return [torch.stack([view.mask(f) for f in self._frames]) for view in self.recording.views]

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """Of the clip."""
        return self.recording.cameras

    def true_shift(self, found: Reconstruction) -> Floats:
        """Shift (F, 3) [m] of every frame to the true translation."""
        ours = [self.subject.landmark_names.index(name) for name in HIPS]
        theirs = [self.truth.landmark_names.index(name) for name in HIPS]
        shift: Floats = self.truth.landmarks[:, theirs].mean(1) - found.landmarks[:, ours].mean(1)
        return shift

    def measure(self, found: Reconstruction) -> Measures:
        """Everything.

        Args:
            found: of all frames of the clip.

        Raises:
            InputError: shapes that do not fit the clip.
        """
        expected = (self.true_garment.shape, self.truth.body_positions.shape)
        if (found.garment.shape, found.body.shape) != expected:
            raise InputError(
                "Reconstruction does not fit the clip",
                where="garment, body",
                expected=f"{expected[0]}, {expected[1]}",
                got=f"{found.garment.shape}, {found.body.shape}",
            )
        placed = found.shifted(self.true_shift(found))
        depth = penetration(
            found.garment,
            self.garment.faces.numpy(),
            found.body,
            self.subject.faces.numpy(),
            held=self.garment.attached.numpy(),
            inactive=self.subject.parts["arms"].numpy(),
        )
        touching = Touching.of(
            found.garment,
            found.body,
            self.subject.faces.numpy(),
            self.subject.parts["arms"].numpy(),
            TOUCHING,
        )
        plain, true = self._placed(found, touching), self._placed(placed, touching)
        return Measures(
            penetration_mean_mm=1e3 * depth.mean_penetrating,
            penetration_max_mm=1e3 * depth.maximum,
            penetration_share=depth.share,
            body_penetration_max_mm=1e3 * depth.body_maximum,
            **plain,
            **{_true(name): value for name, value in true.items()},
        )

    def _placed(self, found: Reconstruction, touching: Touching) -> dict[str, float]:
        """Measures that mind where the person is."""
        balance = balance_with_contact(
            self.garment,
            self.cloth,
            found.garment,
            found.body,
            self.subject.faces.numpy(),
            self.truth.fps,
            touching=touching,
        )
        overlap = self._overlap(found)
        chosen = [self.truth.landmark_names.index(name) for name in self.subject.landmark_names]
        joints = np.linalg.norm(found.landmarks - self.truth.landmarks[:, chosen], axis=-1)
        errors = 1e3 * vertex_distances(torch.from_numpy(found.garment), torch.from_numpy(self.true_garment))
        return {
            "out_of_balance_avg": balance.average_weights,
            "out_of_balance_max": balance.maximum_weights,
            "iou_all": overlap.all_views,
            "iou_reference": overlap.reference_views,
            "iou_single": overlap.single_view,
            "mpjpe_mm": 1e3 * float(joints.mean()),
            "vertex_error_mm": float(errors.mean()),
            "vertex_error_visible_mm": _mean_of(errors[self.visible]),
            "vertex_error_hidden_mm": _mean_of(errors[~self.visible]),
        }

    def _overlap(self, found: Reconstruction) -> ViewOverlap:
        positions = np.concatenate((found.body, found.garment), 1)[self._frames]
        return overlap_in_views(
            self._renderer,
            self.cameras,
            self.masks,
            torch.from_numpy(positions),
            self.faces,
            input_view=self.input_view,
        )


def _mean_of(values: Tensor) -> float:
    return float(values.mean()) if values.numel() else math.nan


def _true(name: str) -> str:
    """Name of a measure with the true translation."""
    stem, unit = (name.removesuffix("_mm"), "_mm") if name.endswith("_mm") else (name, "")
    return f"{stem}_true_translation{unit}"
