"""Last stage: both networks are refined on the video itself, by one camera (Li et al. 2021, section 4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

from torch import Tensor, nn

from toile.capture.deformation.deform import Deformed
from toile.capture.losses.landmarks import landmark_loss
from toile.capture.training.frames import Batch
from toile.learning.capture.physics_stage import PhysicsSettings, PhysicsStage
from toile.limits import Count, CountOrZero, NonNegative, TwoOrMore


@dataclass(frozen=True, kw_only=True)
class AdaptationSettings(PhysicsSettings):
    """Settings of the stage; 300 steps as in the paper, the rest is ours.

    Attributes:
        landmark_weight: of Eq. 4, with pixels as shares of the image's side.
    """

    steps: Count = 300
    batch: Count = 1
    learning_rate: NonNegative = 1e-4
    window: TwoOrMore = 2
    replays: CountOrZero = 0
    landmark_weight: NonNegative = 10.0
    simulation_every: CountOrZero = 20


class AdaptationStage(PhysicsStage):
    """Refines PoseNet by landmarks and SimNet by silhouettes and physics, as one camera sees them.

    The pose has no gradients of what moves the garment. Of one camera it would follow them: a person who
    folds up has less potential energy in the skirt, and landmarks of a single view weigh little against that.

    Args:
        See Stage; ``data`` watched by one camera, ``TrainingSet.only``.
    """

    NAME: ClassVar[str] = "adapt"
    NUMBER: ClassVar[int] = 4
    settings: AdaptationSettings

    @property
    def trained(self) -> Sequence[nn.Module]:
        """See Stage."""
        return (self.pose_net, *super().trained)

    def deformed(self, batch: Batch, images: Tensor) -> tuple[Deformed, Tensor, Tensor]:
        """See SimNetStage; the landmarks alone have gradients of PoseNet."""
        angles, root = self.pose_net(images)
        landmarks = self.placed(batch, self.networks.deformation(angles, root)).landmarks
        world, A, T = self.dressed(batch, images, angles.detach(), root.detach())
        return replace(world, landmarks=landmarks), A, T

    def image_terms(self, batch: Batch, world: Deformed) -> dict[str, Tensor]:
        """Eqs. 4, 5 and 6, with their weights."""
        landmarks = landmark_loss(
            world.landmarks, self.data.cameras, batch.detections.to(world.landmarks), batch.confidences
        )
        weighted = self.settings.landmark_weight * landmarks / self.data.side**2
        return {"landmarks": weighted, **super().image_terms(batch, world)}
