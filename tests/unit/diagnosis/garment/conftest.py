"""A skirt of few vertices on a person who begins to squat, seen by one small camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from toile.capture.body.subject import Subject, load_subject
from toile.capture.data.filming import CameraRing
from toile.capture.garments import Garment, make_skirt
from toile.capture.motion.procedural import make_motion
from toile.diagnosis.garment.bodies import PosedBody, TrackedBody
from toile.diagnosis.garment.effects import EFFECTS
from toile.diagnosis.garment.error_model import ErrorModel
from toile.diagnosis.garment.masks import SmoothedAreas
from toile.diagnosis.garment.responses import Responses, measure_responses
from toile.diagnosis.garment.rollout import Discretisation, RollOuts
from toile.diagnosis.garment.scene import Scene
from toile.physics.energies.membrane import StVenantKirchhoff

Floats = NDArray[np.float64]

FRAMES, FPS = 9, 30.0

FITTED = 2


class TinyStage:
    """See the module.

    Attributes:
        posed: the body with poses.
        look: the model on what is known of the body, its vertices.
        responses: of the model.
        errors: a right model's, out of two null clips.
    """

    def __init__(self) -> None:
        self.form = SmoothedAreas()
        self.subject: Subject = load_subject()
        garment = make_skirt(self.subject, vertices=210)
        self.cameras = replace(CameraRing(), views=1, side=64).cameras()
        self.posed = self._posed(garment)
        tracked = TrackedBody(self.subject, self.posed.moved(0.0, 0.0), self._top(garment))
        self.look = RollOuts(
            self.subject, garment, tracked, self.cameras, FPS, Discretisation(substeps=1), kept=8
        )
        self.responses: Responses = measure_responses(self.look, Scene(), self.form)
        matrix = self.responses.matrix(1, slice(0, FITTED))
        nulls = [self.observed(Scene(), vertices) - self.responses.base for vertices in (300, 330)]
        self.errors = ErrorModel.of([(error[:, :, :FITTED].ravel(), matrix) for error in nulls])

    def observed(self, scene: Scene, vertices: int = 260) -> Floats:
        """Smoothed binary masks of a finer mesh of another law, on the true body."""
        garment = make_skirt(self.subject, vertices=vertices)
        true = RollOuts(
            self.subject,
            garment,
            self._posed(garment),
            self.cameras,
            FPS,
            Discretisation(1, StVenantKirchhoff),
        )
        return self.form((true(scene).masks > 0.5).astype(np.float64))

    def with_effect(self, name: str, coefficient: float) -> Floats:
        """Observed, with so much of an effect."""
        return self.observed(EFFECTS[name].changed(Scene(), coefficient))

    def _posed(self, garment: Garment) -> PosedBody:
        poses = make_motion(self.subject, "squat", FRAMES, FPS, 0)
        return PosedBody(self.subject, poses, self._top(garment))

    @staticmethod
    def _top(garment: Garment) -> float:
        return float(garment.rest_vertices[:, 1].max())


@pytest.fixture(scope="session")
def tiny_stage() -> TinyStage:
    with torch.no_grad():
        return TinyStage()
