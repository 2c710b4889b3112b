"""Per-frame optimisation from one camera, as LiveCap does it (Habermann et al., ACM TOG 38(2), 2019).

No network sees the garment: from a first guess of the pose (LiveCap's comes from a network, too) θ and α are
moved to the 2D landmarks, then A and T of the graph to the silhouette, as rigid as possible. Frames are
solved on their own. LiveCap's photometric term is not there, textures of our clips being unknown.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from toile.capture.deformation.deform import Deformation
from toile.capture.deformation.translation import along_world, global_translation
from toile.capture.losses.attachment import attachment_loss
from toile.capture.losses.joint_limits import joint_limit_loss
from toile.capture.losses.landmarks import landmark_loss
from toile.capture.losses.rigidity import rigidity_loss
from toile.capture.losses.silhouette import BoundaryFinder, silhouette_loss
from toile.capture.prediction import Prediction, SeenFrames
from toile.errors import InputError
from toile.limits import Count, NonNegative, Positive


@dataclass(frozen=True)
class PerFrameSettings:
    """Settings of the optimisation; ours, for images 128 px wide and lengths in metres.

    Attributes:
        pose_iterations: of θ and α.
        surface_iterations: of A and T.
        renew: boundary vertices are found anew after so many iterations.
        pose_rate: of Adam [rad].
        surface_rate: of Adam [rad, m].
        stay: weight that keeps the pose near the guess, one camera being blind to depth [px²/rad²].
        limits: weight of the joint limits [px²/rad²].
        rigidity: weight of L_reg [px²/m²].
        attachment: weight of L_att [px²/m²].
    """

    pose_iterations: Count = 60
    surface_iterations: Count = 40
    renew: Count = 20
    pose_rate: Positive = 0.02
    surface_rate: Positive = 3e-3
    stay: NonNegative = 30.0
    limits: NonNegative = 1e3
    rigidity: NonNegative = 2e3
    attachment: NonNegative = 2e4


def optimised_per_frame(
    deformation: Deformation,
    guess: Prediction,
    frames: SeenFrames,
    fields: Sequence[Tensor],
    settings: PerFrameSettings | None = None,
) -> Prediction:
    """Fit every frame to landmarks and silhouette of the one camera.

    Args:
        deformation: f of the subject and garment.
        guess: poses to begin with; A and T begin with none.
        frames: what the camera has seen.
        fields: signed distances of every frame's mask (F, H, W) [px], see ``losses.silhouette``.
        settings: see PerFrameSettings.

    Raises:
        InputError: other numbers of frames.
    """
    s = settings or PerFrameSettings()
    if not len(guess) == len(fields) == len(frames.detections):
        raise InputError(
            "Frames do not fit together",
            where="guess, fields, frames",
            expected="the same number of frames",
            got=f"{len(guess)}, {len(fields)}, {len(frames.detections)}",
        )
    posed = _posed(deformation, guess, frames, s)
    return _draped(deformation, posed, fields, s)


def _posed(
    deformation: Deformation, guess: Prediction, frames: SeenFrames, s: PerFrameSettings
) -> Prediction:
    """θ and α by the landmarks; the translation follows in closed form.

    Adam does not mind the scale of a loss, so the mean over frames moves each as if it were alone.
    """
    camera = guess.camera
    detections, confidences = frames.detections[:, None], frames.confidences[:, None]
    limits = deformation.subject.joint_limits[deformation.driven]
    angles, root = (x.clone().requires_grad_() for x in (guess.angles, guess.root))

    def placed() -> tuple[Tensor, Tensor]:
        local = along_world(camera, deformation(angles, root).landmarks)
        shift = global_translation(local, [camera], detections, confidences)
        return local + shift[:, None], shift

    adam = torch.optim.Adam([angles, root], lr=s.pose_rate)
    for _ in range(s.pose_iterations):
        adam.zero_grad()
        landmarks, _ = placed()
        away = (angles - guess.angles).square().sum((1, 2)) + (root - guess.root).square().sum(1)
        loss = landmark_loss(landmarks, [camera], detections, confidences)
        loss = loss + s.stay * away.mean() + s.limits * joint_limit_loss(angles, limits)
        loss.backward()  # type: ignore[no-untyped-call]
        adam.step()
    with torch.no_grad():
        _, shift = placed()
    return replace(
        guess, angles=angles.detach(), root=root.detach(), A=None, T=None, translation=shift.detach()
    )


def _draped(
    deformation: Deformation, posed: Prediction, fields: Sequence[Tensor], s: PerFrameSettings
) -> Prediction:
    """A and T by the silhouette."""
    graph, garment = deformation.garment_mesh.graph, deformation.garment
    assert graph is not None
    subject, camera = deformation.subject, posed.camera
    find = BoundaryFinder(
        garment.faces, len(garment.rest_vertices), subject.faces, len(subject.rest_vertices)
    )
    shape = (len(posed), len(graph), 3)
    A, T = (torch.zeros(shape, dtype=torch.float64, requires_grad=True) for _ in range(2))
    _, body = posed.positions(deformation)
    assert body is not None
    adam = torch.optim.Adam([A, T], lr=s.surface_rate)
    boundaries = []
    for step in range(s.surface_iterations):
        adam.zero_grad()
        local = deformation(posed.angles, posed.root, A, T)
        world = local.map(lambda x: along_world(camera, x) + posed.translation[:, None])
        if step % s.renew == 0:
            boundaries = [find(x, b, [camera]) for x, b in zip(world.garment.detach(), body, strict=True)]
        loss = silhouette_loss(world.garment, boundaries, [camera], [[field] for field in fields])
        loss = loss + s.rigidity * rigidity_loss(graph, A, T)
        loss = loss + s.attachment * attachment_loss(world.garment, garment.attached, world.attached)
        loss.backward()  # type: ignore[no-untyped-call]
        adam.step()
    return replace(posed, A=A.detach(), T=T.detach())
