"""Reading a clip frame by frame, from a video file or a folder of images."""

from __future__ import annotations

import logging
import re
from collections.abc import Generator
from contextlib import closing
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from toile.errors import InputError
from toile.scenes.images import image_size, read_rgb

Frame = npt.NDArray[np.uint8]
"""RGB picture (h, w, 3)."""

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")


@dataclass(frozen=True)
class Clip:
    """The chosen frames of a video; nothing is decoded before ``frames`` is iterated over.

    Attributes:
        path: the video file, or a folder of images in the order of their numbers.
        fps: frames per second of the chosen frames.
        height: of a frame [px].
        width: of a frame [px].
        start: first frame chosen, zero-based.
        every: stride.
        n_frames: how many are chosen at most; None for all.
        expected_frames: how many that is likely to be, for a progress bar; None if unknown.
    """

    path: Path
    fps: float
    height: int
    width: int
    start: int = 0
    every: int = 1
    n_frames: int | None = None
    expected_frames: int | None = None

    def frames(self) -> Generator[Frame]:
        """The chosen frames, (h, w, 3) uint8 each, one at a time.

        Raises:
            InputError: a frame that cannot be decoded or has another size, or nothing chosen.
        """
        stop = None if self.n_frames is None else self.start + self.n_frames * self.every
        read = _images if self.path.is_dir() else _decoded
        count = 0
        with closing(read(self.path, self.start, stop, self.every)) as chosen:
            for frame in chosen:
                if frame.shape != (self.height, self.width, 3):
                    raise InputError(
                        "Frames differ in size",
                        where=f"{self.path}: frame {self.start + count * self.every}",
                        expected=f"{self.width} x {self.height} px, as the first",
                        got=f"{frame.shape[1]} x {frame.shape[0]} px",
                    )
                count += 1
                yield frame
        if count == 0:
            raise InputError(
                "No frames are left",
                where=str(self.path),
                expected=f"more than {self.start} frames, because start={self.start}",
                got="a clip that ends before",
            )


def open_clip(
    path: Path | str,
    *,
    start: int = 0,
    n_frames: int | None = None,
    every: int = 1,
    fps: float | None = None,
) -> Clip:
    """Look at a video without decoding it.

    Args:
        path: a file that ffmpeg can read, or a folder of images of one size.
        start: first frame to choose, zero-based.
        n_frames: number of frames to choose; None for all that are there.
        every: choose every second, third ... frame.
        fps: frames per second at which the clip was recorded, before ``every``; None for what the file says.

    Raises:
        InputError: no such file, no video, no images, or a setting that makes no sense.
    """
    path = Path(path)
    for name, value, least in (("start", start, 0), ("n_frames", n_frames, 1), ("every", every, 1)):
        if value is not None and value < least:
            raise InputError(
                f"{name} is too small", where=name, expected=f"a whole number >= {least}", got=f"{value}"
            )
    if fps is not None and not 0 < fps < np.inf:
        raise InputError("Frame rate is not positive", where="fps", expected="fps > 0", got=f"{fps:g}")
    if not path.exists():
        there = sorted(p.name for p in path.parent.iterdir()) if path.parent.is_dir() else None
        raise InputError(
            "Video is missing",
            where=str(path),
            expected="a video file or a folder of images",
            got=f"no folder {path.parent}" if there is None else ", ".join(there[:20]) or "an empty folder",
        )
    stated, (height, width), total = _survey_folder(path) if path.is_dir() else _survey_file(path)
    if fps is None and stated is None:
        raise InputError(
            "Frame rate is unknown",
            where=str(path),
            expected="fps=<frames per second>, because a folder of images does not say it",
            got="fps=null",
        )
    left = None if total is None else max(0, -(-(total - start) // every))
    expected = n_frames if left is None else min(left, n_frames or left)
    rate = float(stated if fps is None else fps)  # type: ignore[arg-type]
    return Clip(path, rate / every, height, width, start, every, n_frames, expected)


def image_files(folder: Path) -> list[Path]:
    """Images of a folder, by the numbers in their names: frame 10 follows frame 9."""
    found = [p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and not p.name.startswith(".")]
    return sorted(found, key=lambda p: [int(s) if s.isdigit() else s for s in re.split(r"(\d+)", p.name)])


def _survey_folder(path: Path) -> tuple[None, tuple[int, int], int]:
    files = image_files(path)
    if not files:
        there = sorted(p.name for p in path.iterdir())
        raise InputError(
            "No frames are there",
            where=str(path),
            expected=f"images ({', '.join(IMAGE_SUFFIXES)})",
            got=", ".join(there[:20]) or "an empty folder",
        )
    return None, image_size(files[0]), len(files)


def _survey_file(path: Path) -> tuple[float, tuple[int, int], int | None]:
    with closing(_read_file(path)) as contents:
        meta = next(contents)
        # One frame is decoded, because a container may declare what it does not hold.
        if next(contents, None) is None:
            raise InputError(
                "No frames are there", where=str(path), expected="a video", got="a file without one"
            )
    width, height = meta["size"]
    fps, seconds = float(meta["fps"]), float(meta["duration"])
    return fps, (height, width), round(fps * seconds) or None


def _images(path: Path, start: int, stop: int | None, every: int) -> Generator[Frame]:
    for file in image_files(path)[start:stop:every]:
        yield read_rgb(file).numpy()


def _decoded(path: Path, start: int, stop: int | None, every: int) -> Generator[Frame]:
    with closing(_read_file(path)) as contents:
        width, height = next(contents)["size"]
        for data in islice(contents, start, stop, every):
            yield np.frombuffer(data, dtype=np.uint8).reshape(height, width, 3)


def _read_file(path: Path) -> Generator[Any]:
    """What ffmpeg says of the file (its size upright, as the frames are), then the frames as bytes."""
    import imageio_ffmpeg

    # It warns of every clip that was filmed upright, though it turns the frames as they should be.
    logging.getLogger("imageio_ffmpeg").setLevel(logging.ERROR)
    try:
        with closing(imageio_ffmpeg.read_frames(str(path))) as contents:
            yield from contents
    except (OSError, RuntimeError, KeyError, ValueError) as error:
        raise _undecodable(path, error) from error


def _undecodable(path: Path, error: Exception) -> InputError:
    # ffmpeg tells its whole story; what went wrong is in the last line.
    story = [line.strip() for line in str(error).splitlines() if line.strip()]
    return InputError(
        "Video cannot be decoded",
        where=str(path),
        expected="a video that ffmpeg can read, or a folder of images",
        got=f"{path.stat().st_size} bytes; {story[-1] if story else type(error).__name__}",
    )
