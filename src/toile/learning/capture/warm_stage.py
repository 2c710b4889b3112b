"""Second stage: SimNet's warm start with a geometric regulariser (Li et al. 2021, Eq. 3)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from toile.capture.deformation.deform import Deformed
from toile.capture.losses.attachment import attachment_loss
from toile.capture.losses.rigidity import rigidity_loss, rotation_loss
from toile.capture.losses.silhouette import BoundaryFinder, silhouette_loss
from toile.capture.training.frames import Batch, TrainingSet
from toile.capture.training.weights import Networks
from toile.errors import InputError
from toile.learning.capture.stage import Stage, StageSettings
from toile.limits import Count, NonNegative, Seed


@dataclass(frozen=True, kw_only=True)
class WarmSettings(StageSettings):
    """Settings of the stage.

    Attributes:
        silhouette_weight: of Eq. 5, with pixels as shares of the images' side.
        rigidity_weight: of L_reg in Eq. 3 [1/m²].
        rotation_weight: of differences in the nodes' rotations; ours [1/rad²].
        attachment_weight: of Eq. 6 [1/m²].
    """

    steps: Count = 1250
    batch: Count = 16
    learning_rate: NonNegative = 5e-4
    silhouette_weight: NonNegative = 30.0
    rigidity_weight: NonNegative = 3.0
    rotation_weight: NonNegative = 3e-3
    attachment_weight: NonNegative = 100.0


class SimNetStage(Stage):
    """What the stages that train SimNet share: PoseNet stays as it is; Eqs. 5 and 6.

    The landmarks of Eq. 4 are of the body, which SimNet does not move here: its loss is a constant and is
    left out.

    Args:
        See Stage.

    Raises:
        InputError: there is no SimNet.
    """

    settings: WarmSettings

    def __init__(self, settings: WarmSettings, networks: Networks, data: TrainingSet, seed: Seed) -> None:
        if networks.sim_net is None:
            raise InputError(
                "There is no SimNet to train",
                where="networks",
                expected="a PoseNet with a new SimNet (Networks.with_sim_net), or both from a file",
                got="a PoseNet alone",
            )
        super().__init__(settings, networks, data, seed)
        self.find = BoundaryFinder(
            data.garment.faces,
            len(data.garment.rest_vertices),
            data.subject.faces,
            len(data.subject.rest_vertices),
        )

    @property
    def trained(self) -> Sequence[nn.Module]:
        """See Stage."""
        assert self.sim_net is not None
        return (self.sim_net,)

    def posed(self, batch: Batch, images: Tensor) -> tuple[Tensor, Tensor]:
        """θ and α by PoseNet, without gradients.

        Args:
            batch: of the frames.
            images: as the networks get them.
        """
        with torch.no_grad():
            angles, root = self.pose_net(images)
        return angles, root

    def deformed(self, batch: Batch, images: Tensor) -> tuple[Deformed, Tensor, Tensor]:
        """Body and garment in the world, and SimNet's A and T."""
        return self.dressed(batch, images, *self.posed(batch, images))

    def dressed(
        self, batch: Batch, images: Tensor, angles: Tensor, root: Tensor
    ) -> tuple[Deformed, Tensor, Tensor]:
        """The same of a pose θ and α that is given."""
        assert self.sim_net is not None
        A, T = self.sim_net(images)
        # The body has no gradients unless the pose has.
        world = self.placed(batch, self.networks.deformation(angles, root, A, T, with_body=True))
        return world, A, T

    def image_terms(self, batch: Batch, world: Deformed) -> dict[str, Tensor]:
        """Eqs. 5 and 6, with their weights."""
        s, data = self.settings, self.data
        assert world.body is not None
        fields = data.distances(batch.samples).to(world.garment)
        boundaries = [
            self.find(garment, body, data.cameras)
            for garment, body in zip(world.garment, world.body, strict=True)
        ]
        silhouettes = silhouette_loss(world.garment, boundaries, data.cameras, fields)
        attachment = attachment_loss(world.garment, data.garment.attached, world.attached)
        return {
            "silhouettes": s.silhouette_weight * silhouettes / data.side**2,
            "attachment": s.attachment_weight * attachment,
        }


class WarmStage(SimNetStage):
    """Trains SimNet by silhouettes, attachment and rigidity.

    Args:
        See Stage.
    """

    NAME: ClassVar[str] = "warm"
    NUMBER: ClassVar[int] = 2

    def terms(self, step: int, rng: np.random.Generator) -> Mapping[str, Tensor]:
        """See Stage."""
        batch = self.data.batch([window[0] for window in self.data.draw(self.settings.batch, 1, rng)])
        world, A, T = self.deformed(batch, self.images_of(batch, rng))
        graph = self.networks.deformation.garment_mesh.graph
        assert graph is not None
        return {
            **self.image_terms(batch, world),
            "rigidity": self.settings.rigidity_weight * rigidity_loss(graph, A, T),
            "rotations": self.settings.rotation_weight * rotation_loss(graph, A),
        }
