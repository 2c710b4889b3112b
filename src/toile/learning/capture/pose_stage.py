"""First stage: PoseNet learns from the landmarks of all cameras (Li et al. 2021, Eq. 4)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from torch import Tensor, nn

from toile.capture.losses.landmarks import landmark_loss
from toile.learning.capture.stage import Stage, StageSettings
from toile.limits import Count, NonNegative


@dataclass(frozen=True, kw_only=True)
class PoseSettings(StageSettings):
    """Settings of the stage.

    Attributes:
        landmark_weight: of Eq. 4, with pixels as shares of the images' side.
        rest_weight: of θ², for angles that landmarks say nothing about; ours [1/rad²].
    """

    steps: Count = 2500
    batch: Count = 16
    learning_rate: NonNegative = 1.5e-3
    landmark_weight: NonNegative = 10.0
    rest_weight: NonNegative = 1e-3


class PoseStage(Stage):
    """Trains PoseNet. θ is between its limits by construction, so that they have no loss here.

    Args:
        See Stage.
    """

    NAME: ClassVar[str] = "pose"
    NUMBER: ClassVar[int] = 1
    settings: PoseSettings

    @property
    def trained(self) -> Sequence[nn.Module]:
        """See Stage."""
        return (self.pose_net,)

    def terms(self, step: int, rng: np.random.Generator) -> Mapping[str, Tensor]:
        """See Stage."""
        samples = [window[0] for window in self.data.draw(self.settings.batch, 1, rng)]
        batch = self.data.batch(samples)
        angles, root = self.pose_net(self.images_of(batch, rng))
        world = self.placed(batch, self.networks.deformation(angles, root))
        landmarks = landmark_loss(
            world.landmarks, self.data.cameras, batch.detections.to(world.landmarks), batch.confidences
        )
        return {
            "landmarks": self.settings.landmark_weight * landmarks / self.data.side**2,
            "rest": self.settings.rest_weight * angles.square().sum((1, 2)).mean(),
        }
