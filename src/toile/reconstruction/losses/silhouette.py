"""Silhouette loss (paper, Eq. 16)."""

from __future__ import annotations

from typing import Annotated, final

from kornia.filters import gaussian_blur2d
from torch import Tensor

from toile.limits import NonNegative, Positive, Unit
from toile.reconstruction.losses.base import VideoLoss
from toile.rendering.base import RenderedImages

_CUTOFF = 3.0  # standard deviations at which the kernel ends


@final
class SilhouetteLoss(VideoLoss):
    """L_sil = 1/N_p Σ_p ‖G(M̂, σ)_p - G(M, σ)_p‖, the mean absolute difference of blurred masks.

    N_p counts every pixel of every frame. Beyond the image both masks are taken as empty.

    Args:
        sigma: standard deviation of the Gaussian [px]; 7 in the paper.
        weight: factor on the term; 1 in the paper.
    """

    def __init__(self, sigma: Annotated[Positive, Unit("px")], weight: NonNegative) -> None:
        self.sigma = sigma
        self.weight = weight

    def __call__(self, rendered: RenderedImages, frames: Tensor, masks: Tensor) -> Tensor:
        """See VideoLoss."""
        size = 2 * int(_CUTOFF * self.sigma + 0.5) + 1
        # The blur is linear: one pass over the difference serves both masks.
        difference = (rendered.silhouette - masks)[:, None]
        blurred = gaussian_blur2d(difference, (size, size), (self.sigma, self.sigma), border_type="constant")
        return self.weight * blurred.abs().mean()
