"""Reading a clip frame by frame, from a video file or a folder of images.

Every frame of a file comes once, at the time at which it is to be shown; nothing is repeated, left out or
interpolated to reach a constant rate.
"""

from __future__ import annotations

import logging
import re
import subprocess
from collections.abc import Generator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from toile.errors import InputError
from toile.json_file import read_json_object
from toile.scenes.findings import Finding, Severity, require
from toile.scenes.frame_times import check_spacing, check_times, settled, uniform_subset
from toile.scenes.images import image_size, read_rgb

Frame = npt.NDArray[np.uint8]
"""RGB picture (h, w, 3)."""

DESCRIPTION = "video.json"
FRAMES = "rgbs"
"""What a scene's description of its clip, and the folder of its frames beside it, are called."""

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")


@dataclass(frozen=True)
class Clip:
    """The chosen frames of a video; nothing is decoded before ``frames`` is iterated over.

    Attributes:
        path: the video file, or a folder of images in the order of their numbers.
        fps: frames per second of the chosen frames, the mean where they are unevenly spaced.
        height: of a frame [px].
        width: of a frame [px].
        start: first frame chosen, zero-based.
        every: stride.
        n_frames: how many are chosen at most; None for all.
        expected_frames: how many that is likely to be, for a progress bar; None if unknown.
        times: of the chosen frames [s], the first 0; None where they are evenly spaced.
        kept: which of the frames that start, every and n_frames choose; None for all.
        remarks: warnings about the times.
    """

    path: Path
    fps: float
    height: int
    width: int
    start: int = 0
    every: int = 1
    n_frames: int | None = None
    expected_frames: int | None = None
    times: tuple[float, ...] | None = None
    kept: tuple[int, ...] | None = None
    remarks: tuple[Finding, ...] = ()

    def frames(self) -> Generator[Frame]:
        """The chosen frames, (h, w, 3) uint8 each, one at a time.

        Raises:
            InputError: a frame that cannot be decoded or has another size, or nothing chosen.
        """
        stop = None if self.n_frames is None else self.start + self.n_frames * self.every
        read = _images if self.path.is_dir() else _decoded
        count = 0
        kept = None if self.kept is None else set(self.kept)
        with closing(read(self.path, self.start, stop, self.every)) as chosen:
            for number, frame in enumerate(chosen):
                if kept is not None and number not in kept:
                    continue
                if frame.shape != (self.height, self.width, 3):
                    raise InputError(
                        "Frames differ in size",
                        where=f"{self.path}: frame {self.start + number * self.every}",
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
        if self.times is not None and count != len(self.times):
            raise InputError(
                "Frames and time stamps differ in number",
                where=str(self.path),
                expected=f"{len(self.times)} frames, or fps=<frames per second> for evenly spaced ones",
                got=f"{count} that can be decoded",
            )

    def evenly_spaced(self, tolerance: float) -> Clip:
        """As many of the frames as are evenly spaced; the clip itself where all are.

        Args:
            tolerance: by which a frame may be off, as a fraction of the interval, below 0.5.
        """
        if self.times is None:
            return self
        subset = uniform_subset(self.times, tolerance)
        n = len(subset.frames)
        chosen = Finding(
            Severity.WARNING,
            "Evenly spaced frames were chosen",
            str(self.path),
            f"frames at most {tolerance:g} of an interval off",
            f"{n} of {len(self.times)} frames, {len(self.times) - n} left out; {subset.fps:.5g} per second, "
            f"at most {1e3 * subset.largest_error:.3g} ms off",
        )
        return replace(
            self, times=None, fps=subset.fps, kept=subset.frames, expected_frames=n, remarks=(chosen,)
        )


def open_clip(
    path: Path | str,
    *,
    start: int = 0,
    n_frames: int | None = None,
    every: int = 1,
    fps: float | None = None,
) -> Clip:
    """Look at a video: its size, and when its frames were taken. Pictures are decoded by ``Clip.frames``.

    The times need a pass of ffmpeg over the chosen part of a file.

    Args:
        path: a file that ffmpeg can read, or a folder of images of one size. The frames of a scene, images
            beside a video.json, have the rate and the times that it says.
        start: first frame to choose, zero-based.
        n_frames: number of frames to choose; None for all that are there.
        every: choose every second, third ... frame.
        fps: frames per second at which the clip was recorded, before ``every``; the frames count as evenly
            spaced then, whatever their time stamps are. None for what the file says.

    Raises:
        InputError: no such file, no video, no images, time stamps that are missing or do not increase
            (without ``fps``), or a setting that makes no sense.
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
    rate = float(stated if fps is None else fps) / every  # type: ignore[arg-type]
    clip = Clip(path, rate, height, width, start, every, n_frames, expected)
    stop = None if n_frames is None else start + n_frames * every
    if path.is_dir():
        described = _described_times(path, total, replaced=fps is not None)
        return clip if described is None else _timed(clip, described[start:stop:every], 0.0, fps)
    stamps, tick = _time_stamps(path, stop)
    # ffmpeg may look at one frame more than it is to pass on.
    return _timed(clip, stamps[start:stop:every], tick, fps)


def _timed(clip: Clip, stamps: Sequence[float | None], tick: float, fps: float | None) -> Clip:
    """The clip with the times of its frames, or a warning where ``fps`` replaces uneven ones."""
    clip = replace(clip, expected_frames=len(stamps))
    known = [t for t in stamps if t is not None]
    if len(stamps) < 2:
        # One frame has no interval; none at all is said when the frames are asked for.
        return clip
    wrong = next((k for k, t in enumerate(known[1:], 1) if t <= known[k - 1]), None)
    if len(known) < len(stamps) or wrong is not None:
        if fps is not None:
            return clip
        missing = f"{len(stamps) - len(known)} of {len(stamps)} missing"
        raise InputError(
            "Time stamps of the frames are broken",
            where=str(clip.path),
            expected="a time for every frame, each later than the one before, or fps=<frames per second> if "
            "they are evenly spaced",
            got=missing
            if wrong is None
            else f"chosen frame {wrong} at {known[wrong]:.6g} s after {known[wrong - 1]:.6g} s",
        )
    times, rate = settled(known, clip.fps if fps is None else None, tick)
    if fps is None:
        return replace(clip, times=times, fps=rate, remarks=tuple(check_spacing(times, str(clip.path))))
    if times is None:
        return clip
    intervals = np.diff(times)
    replaced = Finding(
        Severity.WARNING,
        "fps replaces uneven time stamps",
        str(clip.path),
        "evenly spaced frames; without fps the file's own times are used",
        f"intervals of {1e3 * intervals.min():.4g} to {1e3 * intervals.max():.4g} ms",
    )
    return replace(clip, remarks=(replaced,))


def _describes(folder: Path) -> dict[str, Any]:
    """What the video.json beside a scene's frames says; nothing for another folder."""
    path = folder.parent / DESCRIPTION
    try:
        return read_json_object(path) if folder.name == FRAMES and path.is_file() else {}
    except (OSError, ValueError):
        return {}


def _described_times(folder: Path, n_frames: int | None, *, replaced: bool) -> list[float] | None:
    """Times of a scene's frames, or None where nothing says them.

    Args:
        folder: of the frames.
        n_frames: in it.
        replaced: whether times that are of other frames do not matter, since a rate takes their place.

    Raises:
        InputError: they are those of other frames.
    """
    times = _describes(folder).get("times")
    if times is None:
        return None
    where = str(folder.parent / DESCRIPTION)
    if not isinstance(times, list) or not all(isinstance(t, int | float) for t in times):
        got = str(times)[:100]
        raise InputError("Times cannot be understood", where=where, expected="a list of seconds", got=got)
    if replaced and len(times) != n_frames:
        return None
    require(check_times(times, n_frames or 0, None, where))
    return [float(t) for t in times]


def _time_stamps(path: Path, stop: int | None) -> tuple[list[float | None], float]:
    """Presentation times of the first frames [s], None where there is none, and a tick of their clock [s]."""
    import imageio_ffmpeg

    limit = [] if stop is None else ["-frames:v", str(stop)]
    filters = ["-an", "-sn", "-dn", *_every_frame(), "-vf", "showinfo", *limit]
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-nostdin", "-hide_banner", "-i", str(path), *filters]
    done = subprocess.run(
        [*command, "-f", "null", "-"], stdin=subprocess.DEVNULL, capture_output=True, check=False
    )
    said = done.stderr.decode("utf-8", errors="replace")
    base = re.search(r"config in time_base: (\d+)/(\d+)", said)
    if base is None:
        raise _undecodable(path, RuntimeError(said))
    tick = Fraction(int(base[1]), int(base[2]))
    found = re.findall(r"\] n:\s*\d+ pts:\s*(\S+) ", said)
    return [None if pts == "NOPTS" else float(int(pts) * tick) for pts in found], float(tick)


def _every_frame() -> list[str]:
    """Options with which ffmpeg passes on every frame once, instead of resampling to a constant rate."""
    import imageio_ffmpeg

    # -fps_mode came with version 5.1, and -vsync is gone since.
    version = re.match(r"\D*(\d+)\.(\d+)", imageio_ffmpeg.get_ffmpeg_version())
    old = version is not None and (int(version[1]), int(version[2])) < (5, 1)
    return ["-vsync", "0"] if old else ["-fps_mode", "passthrough"]


def image_files(folder: Path) -> list[Path]:
    """Images of a folder, by the numbers in their names: frame 10 follows frame 9."""
    found = [p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and not p.name.startswith(".")]
    return sorted(found, key=lambda p: [int(s) if s.isdigit() else s for s in re.split(r"(\d+)", p.name)])


def _survey_folder(path: Path) -> tuple[float | None, tuple[int, int], int]:
    files = image_files(path)
    if not files:
        there = sorted(p.name for p in path.iterdir())
        raise InputError(
            "No frames are there",
            where=str(path),
            expected=f"images ({', '.join(IMAGE_SUFFIXES)})",
            got=", ".join(there[:20]) or "an empty folder",
        )
    rate = _describes(path).get("fps")
    stated = float(rate) if isinstance(rate, int | float) and 0 < rate < np.inf else None
    return stated, image_size(files[0]), len(files)


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
        with closing(imageio_ffmpeg.read_frames(str(path), output_params=_every_frame())) as contents:
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
