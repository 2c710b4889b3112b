"""Image loss (paper, Eq. 15)."""

from __future__ import annotations

from typing import final

from torch import Tensor

from toile.limits import NonNegative
from toile.reconstruction.losses.base import VideoLoss
from toile.rendering.base import RenderedImages


@final
class ImageLoss(VideoLoss):
    """L_im = 1/N_p Σ_p ‖Î_p - I_p‖₁.

    The norm sums the absolute differences of the three channels; N_p counts every pixel of every frame, the
    black background included, so a tighter crop gives a larger value.

    Args:
        weight: factor on the term; 1 in the paper.
    """

    def __init__(self, weight: NonNegative) -> None:
        self.weight = weight

    def __call__(self, rendered: RenderedImages, frames: Tensor, masks: Tensor) -> Tensor:
        """See VideoLoss."""
        return self.weight * (rendered.rgb - frames).abs().sum(-1).mean()
