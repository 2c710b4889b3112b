"""The ``cameras`` list of the native layout.

::

    "cameras": [{"name": "left", "image_size": [h, w], "K": [[...]], "R": [[...]], "t": [...],
                 "files": {"rgb": "left/rgb_%03d.png", "mask": "left/mask_%03d.png",
                           "garment_mask": "left/garment_%03d.png", "landmarks": "left/landmarks.npy"},
                 "distortion": [k1, k2, p1, p2, ...]}, ...]

``R``, ``t`` [m]: world to camera frame, x_cam = R x + t; without them the camera's frame is the world. At
least one of "rgb" and "mask" is there. ``landmarks.npy``: (F, L, 3), x, y [px] and confidence of the
landmarks that the key ``landmarks`` of the scene names. ``distortion``: OpenCV's coefficients.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import AfterValidator, BaseModel, ConfigDict, Field
from torch import Tensor

from toile.errors import InputError
from toile.geometry.camera import NO_ROTATION, NO_TRANSLATION, Camera
from toile.limits import Count, Finite
from toile.scenes.findings import Finding, attempt
from toile.scenes.folder_files import inside, sequence
from toile.scenes.views import View

CAMERA_FILES = ("rgb", "mask", "garment_mask", "landmarks")
_Row = tuple[Finite, Finite, Finite]


def without_skew(K: tuple[tuple[float, ...], ...]) -> tuple[tuple[float, ...], ...]:
    """K, if it is an intrinsic matrix without skew.

    Raises:
        ValueError: it is none.
    """
    (_, skew, _), (lower, _, _), last = K
    if last != (0, 0, 1):
        raise ValueError(
            "the last row is not 0 0 1; K may be transposed" if last[0] or last[1] else "K[2][2] is not 1"
        )
    if skew or lower:
        raise ValueError("skew is not supported")
    return K


def _known_files(files: dict[str, str]) -> dict[str, str]:
    unknown = set(files) - set(CAMERA_FILES)
    if unknown:
        raise ValueError(f"{', '.join(sorted(unknown))} is none of {', '.join(CAMERA_FILES)}")
    for key in ("rgb", "mask", "garment_mask"):
        if key in files and files[key].count("%") != 1:
            raise ValueError(f"{key} without one %03d")
        try:
            files.get(key, "%d") % 0
        except (TypeError, ValueError):
            raise ValueError(f"{key} without one %03d") from None
    if any("\0" in path or not path for path in files.values()):
        raise ValueError("not a path")
    return files


class CameraEntry(BaseModel):
    """One entry of ``cameras``; see the module."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)

    name: Annotated[str, Field(pattern=r"^[\w-][\w.-]*$")]
    image_size: tuple[Count, Count]
    K: Annotated[tuple[_Row, _Row, _Row], AfterValidator(without_skew)]
    R: tuple[_Row, _Row, _Row] = NO_ROTATION
    t: _Row = NO_TRANSLATION
    files: Annotated[dict[str, str], AfterValidator(_known_files)]
    distortion: tuple[Finite, ...] = ()

    @property
    def camera(self) -> Camera:
        """The camera, with its pose."""
        (fx, _, cx), (_, fy, cy), _ = self.K
        return Camera(fx, fy, cx, cy, *self.image_size, rotation=self.R, translation=self.t)


EXPECTED = '[{"name", "image_size": [h, w], "K", "R", "t", "files": {"rgb", "mask"}}, ...], at least one'


def read_views(
    folder: Path, entries: Sequence[CameraEntry], n: int
) -> tuple[tuple[View, ...], list[Finding]]:
    """Views of n frames, and what is wrong with their files; nothing but landmarks is read."""
    findings: list[Finding] = []
    read: list[View | None] = [attempt(findings, partial(_view, folder, entry, n)) for entry in entries]
    return tuple(view for view in read if view is not None), findings


def _view(folder: Path, entry: CameraEntry, n: int) -> View:
    def paths(key: str) -> tuple[Path, ...]:
        return sequence(folder, entry.files[key], n) if key in entry.files else ()

    landmarks = None
    if "landmarks" in entry.files:
        landmarks = _read_landmarks(inside(folder, entry.files["landmarks"]))[:n]
    return View(
        name=entry.name,
        camera=entry.camera,
        frame_paths=paths("rgb"),
        mask_paths=paths("mask"),
        garment_mask_paths=paths("garment_mask"),
        landmarks=landmarks,
        distortion=entry.distortion,
    )


def _read_landmarks(path: Path) -> Tensor:
    try:
        array = np.load(path, allow_pickle=False)
        if array.ndim != 3 or array.shape[2] != 3 or array.dtype.kind != "f":
            raise ValueError(f"{array.dtype} {array.shape}")
    except Exception as error:
        raise InputError(
            "Landmarks cannot be read",
            where=str(path),
            expected="a .npy array (F, L, 3): x, y [px], confidence",
            got=f"{type(error).__name__}: {error}",
        ) from error
    return torch.from_numpy(array.astype(np.float32))


def entry_of(view: View, files: Mapping[str, str]) -> dict[str, Any]:
    """The entry of ``cameras`` for a view whose files have those patterns."""
    c = view.camera
    return {
        "name": view.name,
        "image_size": [c.height, c.width],
        "K": [[c.fx, 0.0, c.cx], [0.0, c.fy, c.cy], [0.0, 0.0, 1.0]],
        "R": [list(row) for row in c.rotation],
        "t": list(c.translation),
        "files": dict(files),
        **({"distortion": list(view.distortion)} if view.distortion else {}),
    }


def view_files(view: View, place: str) -> dict[str, str]:
    """Patterns of a view's files within a folder of the scene's, with the suffixes that they have."""
    files = {
        key: f"{place}/{key}_%03d{paths[0].suffix}" for key, paths in _sequences(view).items() if len(paths)
    }
    return files | ({} if view.landmarks is None else {"landmarks": f"{place}/landmarks.npy"})


def copy_view(view: View, folder: Path, place: str) -> None:
    """Copy a view's files to where ``view_files`` says, below the scene's folder."""
    files = view_files(view, place)
    (folder / place).mkdir(parents=True, exist_ok=True)
    for key, paths in _sequences(view).items():
        for k, path in enumerate(paths):
            shutil.copyfile(path, folder / (files[key] % k))
    if view.landmarks is not None:
        np.save(folder / files["landmarks"], view.landmarks.numpy())


def _sequences(view: View) -> dict[str, tuple[Path, ...]]:
    return {"rgb": view.frame_paths, "mask": view.mask_paths, "garment_mask": view.garment_mask_paths}
