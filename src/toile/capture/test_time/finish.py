"""From what networks state to what is shown: smoothed over frames, posed, freed from the body."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from toile.capture.data.clips import Floats, Truth
from toile.capture.deformation.deform import Deformation
from toile.capture.metrics.reconstruction import Reconstruction
from toile.capture.prediction import Prediction
from toile.capture.test_time.resolution import CollisionResolution, ResolutionSettings
from toile.capture.test_time.smoothing import SmoothingSettings, smoothed


@dataclass(frozen=True)
class FinishSettings:
    """What is done at test time.

    Attributes:
        smoothing: see SmoothingSettings.
        resolution: see ResolutionSettings.
        resolve: whether collisions are resolved at the end.
    """

    smoothing: SmoothingSettings = field(default_factory=SmoothingSettings)
    resolution: ResolutionSettings = field(default_factory=ResolutionSettings)
    resolve: bool = True


@dataclass(frozen=True)
class Finished:
    """Body and garment of a clip as they are shown.

    Attributes:
        prediction: smoothed.
        before: garment before the resolution (F, N, 3) [m].
        garment: garment in the end.
        body: (F, V, 3) [m].
        landmarks: (F, L, 3) [m].
        left: largest depth that is left in each frame (F,) [m]; negative where all keep their distance.
    """

    prediction: Prediction
    before: Floats
    garment: Floats
    body: Floats
    landmarks: Floats
    left: Floats

    def reconstruction(self, *, resolved: bool = True) -> Reconstruction:
        """What can be measured, after the resolution or before it."""
        return Reconstruction(self.garment if resolved else self.before, self.body, self.landmarks)

    def motion(self, deformation: Deformation) -> Truth:
        """In the form that pages and exports read."""
        subject = deformation.subject
        return Truth(
            self.body,
            subject.faces.numpy(),
            self.garment,
            deformation.garment.faces.numpy(),
            self.prediction.fps,
            self.landmarks,
            subject.landmark_names,
        )


def finish(
    prediction: Prediction,
    deformation: Deformation,
    settings: FinishSettings | None = None,
    resolution: CollisionResolution | None = None,
) -> Finished:
    """Smooth a prediction, pose it, and resolve collisions.

    The paper resolves first and smooths afterwards; the other way round nothing brings collisions back.

    Args:
        prediction: as the networks state it.
        deformation: f that it belongs to.
        settings: see FinishSettings.
        resolution: of the same garment and subject, if it is there already.

    Raises:
        InputError: what does not fit together.
    """
    settings = settings or FinishSettings()
    calm = smoothed(prediction, settings.smoothing)
    garment, body = calm.positions(deformation)
    assert body is not None
    before, posed = garment.numpy(), body.numpy()
    after, left = before, np.full(len(before), np.nan)
    if settings.resolve:
        made = resolution or CollisionResolution(
            deformation.garment, deformation.subject, settings.resolution
        )
        found = made(before, posed)
        after, left = found.positions, found.left
    return Finished(calm, before, after, posed, calm.landmarks(deformation).numpy(), left)
