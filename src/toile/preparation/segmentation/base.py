"""What all ways of segmenting have in common."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from typing import NamedTuple

from toile.errors import InputError
from toile.preparation.segmentation.cleaning import Cleaning, Mask
from toile.preparation.video import Frame


class Segmented(NamedTuple):
    """A frame and its cleaned mask."""

    frame: Frame
    mask: Mask


class Segmentation(ABC):
    """Finds the cloth in one frame after the other.

    Args:
        cleaning: applied to every mask.
    """

    def __init__(self, cleaning: Cleaning) -> None:
        self.cleaning = cleaning

    @abstractmethod
    def segment(self, frame: Frame, number: int, previous: Segmented | None) -> Mask:
        """Mask (h, w) of a frame, before cleaning.

        Args:
            frame: RGB picture (h, w, 3), uint8.
            number: of the frame, from 0.
            previous: the frame before with its mask; None for the first.
        """

    def masks(self, frames: Iterable[Frame]) -> Iterator[Segmented]:
        """Frames with their cleaned masks, one at a time.

        Raises:
            InputError: a mask is empty, or whatever the method cannot use.
        """
        previous = None
        for number, frame in enumerate(frames):
            mask = self.cleaning(self.segment(frame, number, previous))
            if not mask.any():
                raise InputError(
                    "Mask is empty",
                    where=f"frame {number}",
                    expected="a cloth in every frame; try other settings, or another part of the clip",
                    got="no pixel that belongs to it",
                )
            previous = Segmented(frame, mask)
            yield previous
