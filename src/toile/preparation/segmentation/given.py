"""Masks that were made elsewhere, for example with SAM."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

from toile.errors import InputError
from toile.limits import Level
from toile.preparation.segmentation.base import Segmentation, Segmented
from toile.preparation.segmentation.cleaning import Cleaning, Mask
from toile.preparation.video import Frame, image_files
from toile.scenes.images import read_mask


class Given(Segmentation):
    """One image per chosen frame, in the order of the numbers in their names.

    Args:
        cleaning: applied to every mask.
        folder: of the masks.
        threshold: level (0 to 255) above which a pixel belongs to the cloth.

    Raises:
        InputError: no such folder.
    """

    def __init__(self, cleaning: Cleaning, folder: Path | str, threshold: Level = 127) -> None:
        super().__init__(cleaning)
        self.folder = Path(folder)
        self.threshold = threshold
        if not self.folder.is_dir():
            raise InputError(
                "Folder of masks is missing", where=str(folder), expected="a folder of images", got="none"
            )
        self.files = image_files(self.folder)

    def segment(self, frame: Frame, number: int, previous: Segmented | None) -> Mask:
        """Mask (h, w) of a frame, read from its file.

        Raises:
            InputError: fewer masks than frames, or a mask of another size.
        """
        if number >= len(self.files):
            raise self._miscounted(f"frame {number} has none")
        mask = read_mask(self.files[number]).numpy()
        if mask.shape != frame.shape[:2]:
            raise InputError(
                "Mask and frame differ in size",
                where=str(self.files[number]),
                expected=f"{frame.shape[1]} x {frame.shape[0]} px, as frame {number}",
                got=f"{mask.shape[1]} x {mask.shape[0]} px",
            )
        inside: Mask = mask > self.threshold
        return inside

    def masks(self, frames: Iterable[Frame]) -> Iterator[Segmented]:
        """Frames with their masks, one at a time.

        Raises:
            InputError: a mask is empty or of another size, or there are more or fewer than frames.
        """
        count = 0
        for found in super().masks(frames):
            count += 1
            yield found
        if count < len(self.files):
            raise self._miscounted(f"only {count} frames")

    def _miscounted(self, got: str) -> InputError:
        return InputError(
            "Number of masks is not that of the frames",
            where=str(self.folder),
            expected="one mask per chosen frame (start, every and n_frames choose them)",
            got=f"{len(self.files)} masks, {got}",
        )
