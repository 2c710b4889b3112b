"""The first frame of a folder that has images and masks, but no template yet."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from toile.errors import InputError
from toile.geometry.camera import Camera
from toile.json_file import read_json_object
from toile.preparation.template_making.intrinsics import Intrinsics
from toile.scenes.findings import Finding, Severity, require
from toile.scenes.frame_times import check_spacing, check_times
from toile.scenes.images import numbered_files, read_mask, read_rgb
from toile.scenes.masks import drop_small_components
from toile.scenes.native import FILES
from toile.scenes.validation import check_camera, check_timing

VIDEO = "video.json"


@dataclass(frozen=True)
class Still:
    """What is known of a video before it has a template.

    Attributes:
        folder: of the scene.
        frame: frame 0 (h, w, 3), float32 in [0, 1].
        mask: mask 0 (h, w), float32, 0 or 1, holes filled, the largest components only.
        camera: of the images.
        fps: frames per second, the mean where they are unevenly spaced.
        n_frames: frames that have a mask.
        times: of the frames [s], the first 0; None where they are evenly spaced.
        remarks: warnings about them.
    """

    folder: Path
    frame: Tensor
    mask: Tensor
    camera: Camera
    fps: float
    n_frames: int
    times: tuple[float, ...] | None = None
    remarks: tuple[Finding, ...] = ()


def read_still(folder: Path, intrinsics: Intrinsics, *, fps: float | None, minimum_component: float) -> Still:
    """Read frame 0, mask 0, frame rate and number of frames, and combine them with the intrinsics.

    Args:
        folder: holds ``rgbs/rgb_000.png ...``, ``masks/mask_000.png ...`` and, unless ``fps`` is given,
            ``video.json`` with "fps".
        intrinsics: of the camera.
        fps: frames per second, evenly spaced; None for what ``video.json`` says, its times included.
        minimum_component: drop mask components smaller than this fraction of the largest.

    Raises:
        InputError: a file is missing, or sizes, frame rate or intrinsics are wrong.
    """
    import torch
    from scipy import ndimage

    frame = read_rgb(folder / (FILES["rgb"] % 0)).to(torch.float32) / 255
    mask_path = folder / (FILES["mask"] % 0)
    mask = read_mask(mask_path)
    size = (int(frame.shape[0]), int(frame.shape[1]))
    if tuple(mask.shape) != size:
        raise InputError(
            "Mask and frame differ in size",
            where=str(mask_path),
            expected=f"{size[0]} x {size[1]} px (height x width), as rgb_000.png",
            got=f"{mask.shape[0]} x {mask.shape[1]}",
        )
    if not bool((mask > 127).any()):
        got = "no pixel above 127"
        raise InputError("Mask is empty", where=str(mask_path), expected="the cloth's pixels at 255", got=got)
    mask, _ = drop_small_components(torch.where(mask > 127, mask, 0), minimum_component)
    filled = torch.from_numpy(ndimage.binary_fill_holes(mask.numpy() > 0)).to(torch.float32)
    camera = intrinsics.camera(size, str(folder))
    require(check_camera(camera, "camera"))
    rate = _frame_rate(folder, fps, size)
    n_frames = _count_frames(folder)
    times, remarks = _times(folder, n_frames, rate, replaced=fps is not None)
    return Still(folder, frame, filled, camera, rate, n_frames, times, remarks)


def _times(
    folder: Path, n_frames: int, fps: float, *, replaced: bool
) -> tuple[tuple[float, ...] | None, tuple[Finding, ...]]:
    """Times of the frames by the video's description, or None, and warnings."""
    path = folder / VIDEO
    try:
        given = read_json_object(path).get("times") if path.is_file() else None
        times = None if given is None else tuple(float(t) for t in given)
    except (ValueError, TypeError, AttributeError) as error:
        if replaced:
            return None, ()
        raise InputError(
            f"{VIDEO} cannot be understood",
            where=f"{path}: times",
            expected="a list of seconds, one per frame",
            got=f"{type(error).__name__}: {error}",
        ) from error
    if times is None:
        return None, ()
    if replaced:
        got = f"fps {fps:g}, frames taken as evenly spaced"
        what, expected = "fps replaces the times of the frames", "scene.fps=null, with which they are used"
        return None, (Finding(Severity.WARNING, what, f"{path}: times", expected, got),)
    require(check_times(times, n_frames, fps, str(path)))
    return times, tuple(check_spacing(times, str(path)))


def _frame_rate(folder: Path, fps: float | None, size: tuple[int, int]) -> float:
    path = folder / VIDEO
    expected = f"{VIDEO} with fps, width and height, or fps=<frames per second>"
    if path.is_file():
        try:
            description = read_json_object(path)
            rate = float(description["fps"])
            declared = [
                description.get(key, value) for key, value in zip(("height", "width"), size, strict=True)
            ]
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            if fps is None:
                got = f"{type(error).__name__}: {error}"
                raise InputError(
                    f"{VIDEO} cannot be understood", where=str(path), expected=expected, got=got
                ) from error
        else:
            if declared != list(size):
                raise InputError(
                    f"{VIDEO} and the images differ in size",
                    where=str(path),
                    expected=f"{size[0]} x {size[1]} px (height x width), as rgb_000.png",
                    got=f"{declared[0]} x {declared[1]}",
                )
            fps = rate if fps is None else fps
    if fps is None:
        raise InputError("Frame rate is not known", where=str(path), expected=expected, got="no such file")
    if not math.isfinite(fps):
        fps = -1.0
    require(check_timing(fps, str(folder)))
    return float(fps)


def _count_frames(folder: Path) -> int:
    """Number of frames, each with a mask, without a gap.

    Raises:
        InputError: a gap, or a frame without a mask.
    """
    numbers = {}
    for key in ("rgb", "mask"):
        pattern = Path(FILES[key])
        numbers[key] = numbered_files(folder / pattern.parent, pattern.name.split("%")[0])
    last = max(max(found) for found in numbers.values())
    for key, found in numbers.items():
        gap = next((k for k in range(last + 1) if k not in found), None)
        if gap is not None:
            raise InputError(
                f"Image {Path(FILES[key] % gap).name} is missing",
                where=str(folder / (FILES[key] % gap)),
                expected=f"a frame and a mask for every number from 0 to {last}",
                got=f"{len(numbers['rgb'])} frames and {len(numbers['mask'])} masks",
            )
    return last + 1
