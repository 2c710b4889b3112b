"""Image-gradient loss: the image loss on edges instead of colours."""

from __future__ import annotations

from typing import final

from kornia.filters import spatial_gradient
from torch import Tensor

from toile.limits import NonNegative
from toile.reconstruction.losses.base import VideoLoss
from toile.rendering.base import RenderedImages


@final
class ImageGradientLoss(VideoLoss):
    """1/N_p Σ_p ‖∇Î_p - ∇I_p‖₁ with normalised Sobel derivatives.

    Not in the paper. It does not see changes of brightness that are constant over a neighbourhood. The norm
    sums the absolute differences of both derivatives of the three channels; N_p counts every pixel of every
    frame.

    Args:
        weight: factor on the term.
    """

    def __init__(self, weight: NonNegative) -> None:
        self.weight = weight

    def __call__(self, rendered: RenderedImages, frames: Tensor, masks: Tensor) -> Tensor:
        """See VideoLoss."""
        # The derivative is linear: one pass over the difference serves both images.
        difference = (rendered.rgb - frames).permute(0, 3, 1, 2)
        return self.weight * spatial_gradient(difference).abs().sum((1, 2)).mean()
