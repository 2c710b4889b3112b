"""What a term that compares rendered images with the video takes and returns."""

from __future__ import annotations

from abc import ABC, abstractmethod

from torch import Tensor

from toile.rendering.base import RenderedImages


class VideoLoss(ABC):
    """A term that is a mean over frames, so that a video can be rendered in parts."""

    @abstractmethod
    def __call__(self, rendered: RenderedImages, frames: Tensor, masks: Tensor) -> Tensor:
        """Value of the term.

        Args:
            rendered: images of B frames.
            frames: observed frames, black outside their masks, (B, h, w, 3) in [0, 1].
            masks: observed masks (B, h, w) in [0, 1].

        Returns:
            Mean over the B frames, scalar.
        """
