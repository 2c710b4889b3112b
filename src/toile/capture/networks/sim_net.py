"""SimNet: from an image to the deformation of the garment's graph (Li et al. 2021, section 3.3)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from toile.capture.networks.backbone import BackboneSettings, ResNet

ANGLE = 0.3
"""What an output of 1 stands for in A [rad]; ours, so that both parts learn at one rate."""
LENGTH = 0.05
"""What an output of 1 stands for in T [m]; ours."""


class SimNet(nn.Module):
    """Euler angles and translations of the K nodes of a garment's graph, of one image each.

    The last layer begins with zeros, so that at first the garment is posed with the body and nothing else.

    Args:
        settings: of the backbone.
        nodes: K.
    """

    def __init__(self, settings: BackboneSettings, nodes: int) -> None:
        super().__init__()
        self.backbone = ResNet(settings)
        self.nodes = nodes
        self.head = nn.Linear(self.backbone.n_features, 6 * nodes)
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Deformation in each image.

        Args:
            images: segmented crops (B, 4, S, S), see ``backbone.CHANNELS``.

        Returns:
            A (B, K, 3) [rad] and T (B, K, 3) [m].
        """
        raw = self.head(self.backbone(images)).reshape(-1, self.nodes, 2, 3)
        angles, lengths = torch.unbind(raw, 2)
        return ANGLE * angles, LENGTH * lengths
