"""Silhouette loss (paper, Eq. 16)."""

from __future__ import annotations

from functools import lru_cache
from typing import Annotated, final

import torch
from kornia.filters import filter2d_separable, get_gaussian_kernel1d
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
        # The blur is linear: one pass over the difference serves both masks.
        difference = rendered.silhouette - masks
        rows, columns = (_blur_matrix(n, self.sigma).to(difference) for n in difference.shape[-2:])
        return self.weight * (rows @ difference @ columns).abs().mean()


@lru_cache(maxsize=8)
def _blur_matrix(n: int, sigma: float) -> Tensor:
    """Symmetric matrix (n, n) that blurs a line of n pixels with nothing beyond its ends.

    On one core a product with it is several times faster than a convolution, whose derivative torch computes
    by another convolution that is slower still.
    """
    kernel = get_gaussian_kernel1d(2 * int(_CUTOFF * sigma + 0.5) + 1, sigma, dtype=torch.float64)
    along = torch.ones(1, 1, dtype=torch.float64)
    line = torch.eye(n, dtype=torch.float64)[None, None]
    return filter2d_separable(line, along, kernel, border_type="constant")[0, 0]
