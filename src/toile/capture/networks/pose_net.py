"""PoseNet: from an image to joint angles θ and the rotation α of the root (Li et al. 2021, section 3.3)."""

from __future__ import annotations

import roma
import torch
from torch import Tensor, nn

from toile.capture.body.limits import AXES
from toile.capture.networks.backbone import BackboneSettings, ResNet


class PoseNet(nn.Module):
    """Joint angles within their limits and the root's rotation, of one image each.

    θ lies between its limits by a hyperbolic tangent, at the rest pose at first. α comes as two columns of a
    rotation matrix (Zhou et al., On the continuity of rotation representations, CVPR 2019) and is written as
    angles afterwards: a person may turn by a whole turn, where angles jump. Angles and root in the paper are
    both free; both changes are ours.

    Args:
        settings: of the backbone.
        limits: least and largest θ of the driven joints (D, 3, 2) [rad], infinite where there is none, e.g.
            ``subject.joint_limits[deformation.driven]``.
    """

    middle: Tensor
    reach: Tensor
    offset: Tensor

    def __init__(self, settings: BackboneSettings, limits: Tensor) -> None:
        super().__init__()
        self.backbone = ResNet(settings)
        low, high = limits.double().unbind(-1)
        both = torch.isfinite(low) & torch.isfinite(high)
        # No limits: half a turn either way.
        low, high = torch.where(both, low, -torch.pi), torch.where(both, high, torch.pi)
        middle, half = (low + high) / 2, (high - low) / 2
        # Limits are not weights: they follow from the subject.
        self.register_buffer("middle", middle.float(), persistent=False)
        self.register_buffer("reach", half.float(), persistent=False)
        inner = (-middle / half.clamp(min=1e-6)).clamp(-0.98, 0.98)
        self.register_buffer("offset", torch.atanh(inner).float(), persistent=False)
        self.n_joints = len(limits)
        self.head = nn.Linear(self.backbone.n_features, 3 * self.n_joints + 6)
        with torch.no_grad():
            self.head.weight.mul_(0.1)
            self.head.bias.zero_()
            # Two columns of the identity: upright, facing the camera.
            self.head.bias[-6:] = torch.tensor([1.0, 0.0, 0.0, 0.0, 1.0, 0.0])

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Pose in each image.

        Args:
            images: segmented crops (B, 4, S, S), see ``backbone.CHANNELS``.

        Returns:
            θ (B, D, 3) [rad] and α (B, 3) [rad]; α relative to the camera that made the image.
        """
        raw = self.head(self.backbone(images))
        angles, root = raw[:, :-6], raw[:, -6:]
        angles = angles.reshape(-1, self.n_joints, 3)
        theta = self.middle + self.reach * torch.tanh(self.offset + angles / self.reach.clamp(min=1e-6))
        first = torch.nn.functional.normalize(root[:, :3], dim=-1)
        second = root[:, 3:] - (first * root[:, 3:]).sum(-1, keepdim=True) * first
        second = torch.nn.functional.normalize(second, dim=-1)
        rotation = torch.stack((first, second, torch.linalg.cross(first, second)), -1)
        alpha: Tensor = roma.rotmat_to_euler(AXES, rotation)
        return theta, alpha
