"""Cloth in front of one uniform colour, black unless said otherwise."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from toile.errors import InputError
from toile.limits import Level
from toile.preparation.segmentation.base import Segmentation, Segmented
from toile.preparation.segmentation.cleaning import Cleaning, Mask
from toile.preparation.video import Frame


class DarkBackground(Segmentation):
    """Everything that differs from the background's colour in any channel.

    Args:
        cleaning: applied to every mask; filled holes are what brings back dark spots of the cloth.
        threshold: smallest difference [levels of 255] that counts; compression blurs a black background by
            a few levels.
        background: colour of the background, red, green, blue, 0 to 255.
    """

    def __init__(
        self, cleaning: Cleaning, threshold: Level = 16, background: Sequence[Level] = (0, 0, 0)
    ) -> None:
        super().__init__(cleaning)
        if not 0 <= threshold <= 255:
            raise InputError(
                "Threshold is out of range",
                where="method.threshold",
                expected="0 to 255 levels",
                got=f"{threshold}",
            )
        if len(background) != 3 or not all(0 <= level <= 255 for level in background):
            raise InputError(
                "Background is no colour",
                where="method.background",
                expected="[red, green, blue], 0 to 255 each",
                got=str(list(background)),
            )
        self.threshold = threshold
        self.background = np.array(background, dtype=np.int16)

    def segment(self, frame: Frame, number: int, previous: Segmented | None) -> Mask:
        """Mask (h, w) of a frame; no other frame matters."""
        mask: Mask = (np.abs(frame - self.background) > self.threshold).any(-1)
        return mask
