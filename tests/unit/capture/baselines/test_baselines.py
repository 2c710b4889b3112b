"""What the method is compared with does what it is named after."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from toile.capture.baselines.one_piece import OnePieceDeformation
from toile.capture.baselines.per_frame import PerFrameSettings, optimised_per_frame
from toile.capture.baselines.simulation import simulated
from toile.capture.baselines.skinning import skinned
from toile.capture.layer.layer import SimulationLayer
from toile.capture.losses.silhouette import distance_field
from toile.capture.prediction import Prediction
from toile.capture.test_time.resolution import CollisionResolution
from toile.capture.training.frames import camera_frames
from toile.errors import InputError
from toile.scenes.multi_view import load_multi_view


@pytest.fixture(scope="module")
def true_prediction(tiny_clip: Any) -> Prediction:
    camera = load_multi_view(tiny_clip.folder).cameras[0]
    pose = tiny_clip.pose
    return Prediction(pose.angles, pose.root, None, None, pose.translation, camera, 30.0)


def test_skinning_is_the_pose_alone(tiny_clip: Any, true_prediction: Prediction) -> None:
    shape = (len(true_prediction), 12, 3)
    bent = replace(
        true_prediction,
        A=torch.zeros(shape, dtype=torch.float64),
        T=torch.full(shape, 0.05, dtype=torch.float64),
    )
    found, _ = skinned(bent).positions(tiny_clip.deformation)
    np.testing.assert_allclose(found.numpy(), tiny_clip.truth.garment_positions, atol=1e-9)


def test_one_piece_moves_body_and_garment_alike(tiny_clip: Any, true_prediction: Prediction) -> None:
    one = OnePieceDeformation(tiny_clip.subject, tiny_clip.garment, 24)
    graph = one.garment_mesh.graph
    assert graph is not None
    on_garment = graph.vertices >= len(tiny_clip.subject.rest_vertices)
    assert 0 < int(on_garment.sum()) < 24
    shift = torch.tensor([0.0, 0.07, 0.0], dtype=torch.float64).expand(len(true_prediction), 24, 3)
    moved = replace(true_prediction, A=torch.zeros_like(shift), T=shift)
    (garment, body), (plain, posed) = moved.positions(one), true_prediction.positions(one)
    assert body is not None
    assert posed is not None
    # A shift of all nodes at rest moves both, and the waist stays where it is on the body.
    assert float((body - posed).norm(dim=-1).min()) > 0.06
    attached = tiny_clip.garment.attached
    local = one(moved.angles, moved.root, moved.A, moved.T)
    assert float((local.garment[:, attached] - local.attached).norm(dim=-1).max()) < 0.02
    assert float((garment - plain).norm(dim=-1).min()) > 0.06


def test_per_frame_optimisation_comes_nearer_to_landmarks_and_silhouette(
    tiny_clip: Any, true_prediction: Prediction
) -> None:
    recording = load_multi_view(tiny_clip.folder)
    frames = camera_frames(recording, 0, tiny_clip.subject.landmark_names, 64)
    noise = torch.randn(true_prediction.angles.shape, generator=torch.Generator().manual_seed(0)).double()
    guess = replace(true_prediction, angles=true_prediction.angles + 0.1 * noise)
    fields = [distance_field(recording.views[0].mask(f) > 0.5) for f in range(len(guess))]
    settings = PerFrameSettings(pose_iterations=40, surface_iterations=10, renew=10)
    found = optimised_per_frame(tiny_clip.deformation, guess, frames, fields, settings)
    assert found.A is not None

    def seen(prediction: Prediction) -> float:
        pixels = prediction.camera.project(prediction.landmarks(tiny_clip.deformation))
        known = frames.confidences > 0
        return float((pixels - frames.detections)[known].norm(dim=-1).mean())

    assert seen(found) < 0.5 * seen(guess)
    with pytest.raises(InputError, match="same number of frames"):
        optimised_per_frame(tiny_clip.deformation, guess, frames, fields[:-1], settings)


def test_simulation_follows_the_bodies_and_not_the_picture(
    tiny_clip: Any, true_prediction: Prediction
) -> None:
    layer = SimulationLayer.of(tiny_clip.garment, tiny_clip.subject)
    resolution = CollisionResolution(tiny_clip.garment, tiny_clip.subject)
    garment, body = true_prediction.positions(tiny_clip.deformation)
    assert body is not None
    motion = simulated(layer, resolution, body[:2], garment[0], 30.0, substeps=2)
    assert bool(motion.converged.all())
    assert motion.garment_positions.shape == (2, *garment.shape[1:])
