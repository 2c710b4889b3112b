"""Image features that survive changes of light: band-passed colour with normalised contrast.

Everything is weighted by the observed mask, so that the black background never bleeds into the cloth.
"""

from __future__ import annotations

import torch
from kornia.filters import gaussian_blur2d
from torch import Tensor


def _blur(images: Tensor, sigma: float) -> Tensor:
    """Gaussian blur of (F, C, h, w); the kernel ends at three standard deviations."""
    if sigma == 0:
        return images
    size = 2 * int(3 * sigma + 0.5) + 1
    return gaussian_blur2d(images, (size, size), (sigma, sigma), border_type="replicate")


def contrast_features(
    frames: Tensor, masks: Tensor, blur: float, neighbourhood: float | None, contrast: float = 0.15
) -> Tensor:
    """Colour features for matching, and the blurred mask as the last channel.

    Args:
        frames: (F, h, w, 3) in [0, 1].
        masks: (F, h, w) in [0, 1].
        blur: σ of the pre-blur [px]; sets the scale that the features describe.
        neighbourhood: σ of the window [px] whose mean is removed and whose contrast is normalised; None keeps
            the colours themselves.
        contrast: root mean square of the normalised features.

    Returns:
        (F, h, w, 4) float32: three colour features and the mask blurred by ``blur``.
    """
    out = torch.empty(*frames.shape[:3], 4, dtype=torch.float32)
    for t in range(frames.shape[0]):  # one frame at a time: a batch would need gigabytes at full resolution
        mask = masks[t][None, None].to(torch.float32)
        image = frames[t].permute(2, 0, 1)[None].to(torch.float32) * mask
        weight = _blur(mask, blur)
        feature = _blur(image, blur) / weight.clamp_min(1e-3)
        if neighbourhood is not None:
            support = _blur(mask, neighbourhood).clamp_min(1e-3)
            feature = feature - _blur(image, neighbourhood) / support
            power = _blur(feature.square().mean(1, keepdim=True) * mask, neighbourhood) / support
            feature = feature * (contrast / (power.clamp_min(0).sqrt() + 0.02))
        out[t, ..., :3] = (feature * (weight > 0.1))[0].permute(1, 2, 0)
        out[t, ..., 3] = weight[0, 0]
    return out
