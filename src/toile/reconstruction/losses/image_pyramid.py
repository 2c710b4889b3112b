"""Image loss on several scales at once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import final

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from toile.errors import InputError
from toile.limits import NonNegative
from toile.reconstruction.losses.base import VideoLoss
from toile.rendering.base import RenderedImages


@final
class ImagePyramidLoss(VideoLoss):
    """Mean over scales s of 1/N_s Σ_p ‖(P_s (Î - I))_p‖₁, where P_s averages squares of s × s pixels.

    Not in the paper, whose image loss (Eq. 15) is scale 1. A texture that is misplaced by more than its own
    detail has no slope towards its place at scale 1; on coarser scales it has. The norm sums the absolute
    differences of the three channels; squares at the lower and right border may be smaller.

    Args:
        weight: factor on the term.
        scales: sides of the squares [px].

    Raises:
        InputError: no scale, or one below 1.
    """

    def __init__(self, weight: NonNegative, scales: Sequence[int]) -> None:
        if not scales or min(scales) < 1:
            raise InputError(
                "Unusable scales of the image loss",
                where="scales",
                expected="sides of squares of pixels, each at least 1",
                got=str(list(scales)),
            )
        self.weight = weight
        self.scales = tuple(int(s) for s in scales)

    def __call__(self, rendered: RenderedImages, frames: Tensor, masks: Tensor) -> Tensor:
        """See VideoLoss."""
        difference = (rendered.rgb - frames).permute(0, 3, 1, 2)
        per_scale = [
            (difference if s == 1 else avg_pool2d(difference, s, ceil_mode=True, count_include_pad=False))
            .abs()
            .sum(1)
            .mean()
            for s in self.scales
        ]
        return self.weight * torch.stack(per_scale).mean()
