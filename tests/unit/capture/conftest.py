"""A tiny clip: three frames of the default subject in a coarse skirt, seen by two cameras."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from toile.capture.body.subject import Subject, load_subject
from toile.capture.data.clips import TRUTH_FILE, Truth
from toile.capture.data.filming import CameraRing, LandmarkNoise, Looks, film
from toile.capture.deformation.deform import (
    Deformation,
    PoseParameters,
    parameters_of_poses,
)
from toile.capture.deformation.graph import embedded_graph
from toile.capture.deformation.translation import along_world
from toile.capture.garments import Garment, make_skirt
from toile.capture.motion.procedural import make_motion
from toile.rendering.warp.renderer import WarpRenderer
from toile.scenes.native import write_multi_view_description
from toile.scenes.native_views import view_files

FRAMES, FIRST = 4, 20


class TinyClip:
    """See the module.

    Attributes:
        folder: of the clip; subject.npz and garment.npz lie beside it.
        subject, garment: who and what.
        deformation: f with 12 nodes.
        pose: true parameters relative to the first camera.
        truth: body and garment, the latter posed with the body.
    """

    def __init__(self, place: Path) -> None:
        self.subject: Subject = load_subject()
        self.garment: Garment = make_skirt(self.subject, vertices=300)
        graph = embedded_graph(self.garment.rest_vertices, self.garment.faces, 12)
        self.deformation = Deformation(self.subject, self.garment, graph)
        cameras = replace(CameraRing(), views=2, side=64).cameras()
        poses = make_motion(self.subject, "walk", FIRST + FRAMES, 30.0, 3)[FIRST:]
        self.pose: PoseParameters = parameters_of_poses(self.subject, poses, cameras[0])
        local = self.deformation(self.pose.angles, self.pose.root, with_body=True)
        world = local.map(lambda x: along_world(cameras[0], x) + self.pose.translation[:, None])
        assert world.body is not None
        garment = world.garment.numpy()
        self.truth = Truth(
            world.body.numpy(),
            self.subject.faces.numpy(),
            garment,
            self.garment.faces.numpy(),
            30.0,
            world.landmarks.numpy(),
            self.subject.landmark_names,
            {"model_positions": garment.astype(np.float32)},
        )
        self.folder = place / "000-walk"
        self.folder.mkdir(parents=True)
        rng = np.random.default_rng(0)
        looks = Looks.random(rng, 64)
        noise = LandmarkNoise(deviation=0.0, lost=0.0)
        recording = film(self.truth, cameras, looks, noise, rng, WarpRenderer(2), self.folder, "walk")
        files = [view_files(view, f"views/{view.name}") for view in recording.views]
        write_multi_view_description(recording, self.folder, files)
        self.truth.save(self.folder / TRUTH_FILE, recording)
        self.subject.save(place / "subject.npz")
        self.garment.save(place / "garment.npz")


@pytest.fixture(scope="session")
def tiny_clip(tmp_path_factory: pytest.TempPathFactory) -> TinyClip:
    with torch.no_grad():
        return TinyClip(tmp_path_factory.mktemp("people"))
