"""A recording out of one's own video: frames, masks of person and garment, 2D landmarks, one camera.

::

    masks/person/*.png    the person with the garment, one per frame
    masks/garment/*.png   the garment alone
    landmarks             a folder of OpenPose's JSON files, one per frame, or an .npy of (F, L, 3)
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from torch import Tensor

from toile.capture.data.filming import UP, view_of
from toile.errors import InputError
from toile.geometry.camera import Camera, looking_at
from toile.limits import NonNegative, Positive, Unit
from toile.preparation.video import Clip, image_files
from toile.progress import Report, silent
from toile.scenes.atomic_folder import folder_written_atomically
from toile.scenes.images import read_mask, write_image, write_levels
from toile.scenes.native import write_multi_view_description
from toile.scenes.native_views import view_files
from toile.scenes.openpose import read_openpose
from toile.scenes.views import BODY_25, MultiView

PERSON, GARMENT = "person", "garment"
_LABEL = "camera0"


@dataclass(frozen=True)
class OwnCamera:
    """The camera of a video, still and level but for its pitch.

    Attributes:
        field_of_view: across the longer side of the image.
        height: above the floor.
        pitch: downwards.
    """

    field_of_view: Annotated[Positive, Unit("degrees")] = 50.0
    height: Annotated[NonNegative, Unit("m")] = 1.2
    pitch: Annotated[float, Unit("degrees")] = 0.0

    def camera(self, width: int, height: int) -> Camera:
        """At (0, height, 0), looking along -z, for images of that size [px]."""
        f = 0.5 * max(width, height) / math.tan(math.radians(self.field_of_view) / 2)
        down = math.radians(self.pitch)
        centre = torch.tensor([0.0, self.height, 0.0], dtype=torch.float64)
        ahead = torch.tensor([0.0, -math.sin(down), -math.cos(down)], dtype=torch.float64)
        plain = Camera(f, f, width / 2, height / 2, height, width)
        return looking_at(plain, centre, centre + ahead, UP)


def write_own_clip(
    clip: Clip,
    masks: Path,
    landmarks: Path,
    camera: OwnCamera,
    landmark_names: Sequence[str],
    folder: Path,
    report: Report = silent,
) -> Path:
    """Write a recording in the native layout, as everything here reads it.

    Args:
        clip: the video.
        masks: folder with ``person`` and ``garment``.
        landmarks: folder of OpenPose, or an .npy of the subject's landmarks.
        camera: see OwnCamera.
        landmark_names: of the subject.
        folder: target, new.
        report: progress.

    Returns:
        The folder.

    Raises:
        InputError: something is missing, or numbers or sizes do not fit.
    """
    paths = {name: _mask_files(masks / name) for name in (PERSON, GARMENT)}
    marks, names = _landmarks(landmarks, landmark_names)
    with folder_written_atomically(folder, overwrite=False) as new:
        place = new / "views" / _LABEL
        place.mkdir(parents=True)
        count = 0
        with closing(clip.frames()) as frames:
            for f, frame in enumerate(frames):
                write_levels(place / f"rgb_{f:03d}.png", frame)
                for name, stem in ((PERSON, "mask"), (GARMENT, "garment_mask")):
                    _copy_mask(paths[name], f, frame.shape[:2], place / f"{stem}_{f:03d}.png")
                count += 1
                report("frames read", count, clip.expected_frames)
        for name, n in ((str(masks / PERSON), len(paths[PERSON])), (str(landmarks), len(marks))):
            if n != count:
                raise InputError(
                    "Frames do not fit together",
                    where=name,
                    expected=f"{count}, one for each frame of {clip.path}",
                    got=str(n),
                )
        np.save(place / "landmarks.npy", marks.numpy(), allow_pickle=False)
        made = camera.camera(clip.width, clip.height)
        view = view_of(_LABEL, made, new, count, marks)
        recording = MultiView(folder.name, (view,), clip.fps, tuple(names))
        write_multi_view_description(recording, new, [view_files(view, f"views/{_LABEL}")])
    return folder


def _mask_files(folder: Path) -> list[Path]:
    found = image_files(folder) if folder.is_dir() else []
    if not found:
        raise InputError(
            "Masks are missing",
            where=str(folder),
            expected=f"images, one per frame; masks=<folder> holds {PERSON}/ and {GARMENT}/",
            got="no images" if folder.is_dir() else "no such folder",
        )
    return found


def _copy_mask(paths: list[Path], f: int, size: tuple[int, ...], target: Path) -> None:
    if f >= len(paths):
        raise InputError(
            "Frames do not fit together",
            where=str(paths[0].parent),
            expected="one mask for each frame of the video",
            got=f"{len(paths)}, and more frames",
        )
    mask = read_mask(paths[f])
    if tuple(mask.shape) != tuple(size):
        raise InputError(
            "Mask has another size than its frame",
            where=str(paths[f]),
            expected=f"{size[1]} x {size[0]} px",
            got=f"{mask.shape[1]} x {mask.shape[0]} px",
        )
    write_image(target, mask.float() / 255)


def _landmarks(path: Path, names: Sequence[str]) -> tuple[Tensor, Sequence[str]]:
    """(F, L, 3), float32: x, y [px], confidence; and what they are called."""
    if path.is_dir():
        files = sorted(path.glob("*.json"))
        if not files:
            raise InputError(
                "Landmarks are missing",
                where=str(path),
                expected="OpenPose's JSON files, one per frame",
                got="none",
            )
        return read_openpose(files)[0], BODY_25
    try:
        found = np.load(path, allow_pickle=False)
    except Exception as error:
        raise InputError(
            "Landmarks cannot be read",
            where=str(path),
            expected="a folder of OpenPose's JSON files, or an .npy",
            got=f"{type(error).__name__}: {error}",
        ) from error
    good = isinstance(found, np.ndarray) and found.ndim == 3 and found.shape[1:] == (len(names), 3)
    if not good or not np.isfinite(found).all():
        raise InputError(
            "Landmarks do not fit the subject",
            where=str(path),
            expected=f"finite numbers of shape (F, {len(names)}, 3): {', '.join(names[:3])}, ...",
            got=str(getattr(found, "shape", type(found).__name__)),
        )
    return torch.from_numpy(found.astype(np.float32)), names
