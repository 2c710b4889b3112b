"""Rows of the tables: ways from what one camera has seen to body and garment, all measured alike."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import torch

from toile.capture.baselines.per_frame import PerFrameSettings, optimised_per_frame
from toile.capture.baselines.simulation import simulated
from toile.capture.baselines.skinning import skinned
from toile.capture.layer.layer import SimulationLayer
from toile.capture.losses.silhouette import distance_field
from toile.capture.metrics.reconstruction import MeasuredClip, Reconstruction
from toile.capture.prediction import Prediction, predict
from toile.capture.test_time.finish import Finished, FinishSettings, finish
from toile.capture.test_time.resolution import CollisionResolution
from toile.capture.training.frames import CameraFrames, camera_frames
from toile.capture.training.weights import Networks


@dataclass(frozen=True)
class Outcome:
    """What a row says about a clip.

    Attributes:
        before: before the final resolution.
        after: after it.
    """

    before: Reconstruction
    after: Reconstruction


class Case:
    """One clip and the networks that a row starts from.

    Args:
        networks: of one training.
        clip: to reconstruct from its input view.
        settings: of what is done at test time.

    Attributes:
        networks, clip, settings: see above.
    """

    def __init__(self, networks: Networks, clip: MeasuredClip, settings: FinishSettings) -> None:
        self.networks, self.clip, self.settings = networks, clip, settings

    @cached_property
    def frames(self) -> CameraFrames:
        """What the input view has seen."""
        side = self.networks.settings.backbone.side
        return camera_frames(
            self.clip.recording, self.clip.input_view, self.networks.subject.landmark_names, side
        )

    @cached_property
    def resolution(self) -> CollisionResolution:
        """Of the garment."""
        return CollisionResolution(self.networks.garment, self.networks.subject, self.settings.resolution)

    def stated(self, *, with_garment: bool = True) -> Prediction:
        """What the networks state, of the pose alone or of the garment, too."""
        networks = self.networks
        sim_net = networks.sim_net if with_garment else None
        return predict(networks.pose_net, sim_net, self.frames, networks.deformation)

    def finished(self, prediction: Prediction) -> Finished:
        """Smoothed and resolved."""
        return finish(prediction, self.networks.deformation, self.settings, self.resolution)


class Method(ABC):
    """A way to reconstruct."""

    def __call__(self, case: Case) -> Outcome:
        """Reconstruct a clip."""
        found = case.finished(self.prediction(case))
        return Outcome(found.reconstruction(resolved=False), found.reconstruction())

    @abstractmethod
    def prediction(self, case: Case) -> Prediction:
        """Before anything is smoothed."""


class NetworkMethod(Method):
    """Both networks, as they were trained."""

    def prediction(self, case: Case) -> Prediction:
        """See Method."""
        return case.stated()


class SkinningMethod(Method):
    """PoseNet, the garment with the body."""

    def prediction(self, case: Case) -> Prediction:
        """See Method."""
        return skinned(case.stated(with_garment=False))


@dataclass(frozen=True)
class PerFrameMethod(Method):
    """PoseNet as a guess, then every frame optimised by what the camera has seen of it."""

    settings: PerFrameSettings = field(default_factory=PerFrameSettings)

    def prediction(self, case: Case) -> Prediction:
        """See Method."""
        view = case.clip.recording.views[case.clip.input_view]
        fields = [distance_field(view.mask(f) > 0.5) for f in range(case.clip.truth.n_frames)]
        guess = case.stated(with_garment=False)
        return optimised_per_frame(case.networks.deformation, guess, case.frames, fields, self.settings)


class SimulationMethod(SkinningMethod):
    """PoseNet's bodies, smoothed, and the garment simulated on them."""

    def __call__(self, case: Case) -> Outcome:
        """See Method."""
        found = case.finished(self.prediction(case))
        layer = SimulationLayer.of(case.networks.garment, case.networks.subject)
        motion = simulated(
            layer,
            case.resolution,
            torch.from_numpy(found.body),
            torch.from_numpy(found.before[0]),
            case.clip.truth.fps,
        )
        resolved = motion.garment_positions
        if case.settings.resolve:
            resolved = case.resolution(motion.garment_positions, found.body).positions
        return Outcome(
            Reconstruction(motion.garment_positions, found.body, found.landmarks),
            Reconstruction(resolved, found.body, found.landmarks),
        )


@dataclass(frozen=True)
class Row:
    """A row of the tables.

    Attributes:
        title: as tables say it.
        weights: of the training, below the folder of its seed; {domain} and {clip} are the clip's.
        method: what is done with them.
        ablation: whether it is the physics stage with something changed.
    """

    title: str
    weights: str
    method: Method
    ablation: bool = False


ROWS: Mapping[str, Row] = {
    "skinning": Row("PoseNet, skinning only", "pose/weights.pt", SkinningMethod()),
    "one_piece": Row("one piece with ARAP (DeepCap-like)", "one_piece/warm/weights.pt", NetworkMethod()),
    "per_frame": Row("per-frame optimisation (LiveCap-like)", "pose/weights.pt", PerFrameMethod()),
    "simulation": Row("pure simulation on PoseNet's body", "pose/weights.pt", SimulationMethod()),
    "warm": Row("warm start", "warm/weights.pt", NetworkMethod()),
    "physics": Row("physics", "physics/weights.pt", NetworkMethod()),
    "eq8_alone": Row("physics by Eq. 8 alone", "physics-eq8_alone/weights.pt", NetworkMethod(), True),
    "potential_alone": Row(
        "physics by the potential alone", "physics-potential_alone/weights.pt", NetworkMethod(), True
    ),
    "no_silhouette_rays": Row(
        "Eq. 8 alone, without Eq. 1", "physics-no_silhouette_rays/weights.pt", NetworkMethod(), True
    ),
    "frames_2": Row("Eq. 8 alone, F = 2", "physics-frames_2/weights.pt", NetworkMethod(), True),
    "frames_5": Row("Eq. 8 alone, F = 5", "physics-frames_5/weights.pt", NetworkMethod(), True),
    "through_layer": Row(
        "Eq. 8 alone, gradients through S", "physics-through_layer/weights.pt", NetworkMethod(), True
    ),
    "coarse_graph": Row("warm start, 32 nodes", "coarse_graph/warm/weights.pt", NetworkMethod(), True),
    "adaptation": Row("physics + adaptation", "{domain}/adapt/{clip}/weights.pt", NetworkMethod()),
}
"""By the names that the CSV has."""
