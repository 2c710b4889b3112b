"""Camera intrinsics given as numbers or by a file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from toile.errors import InputError
from toile.geometry.camera import Camera
from toile.json_file import read_json_object

_EXPECTED = (
    'camera.fx, fy, cx, cy [px], or camera.file with "K": [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] '
    '(scene.json) or "focal_length": [fx, fy] and "optical_center": [cx, cy] (φ-SfT)'
)


@dataclass(frozen=True)
class Intrinsics:
    """Where the intrinsics come from: four numbers [px], or a JSON file of either layout.

    Attributes:
        file: scene.json with "K", or a φ-SfT scene file; None if the numbers are given.
        fx, fy, cx, cy: focal lengths and principal point [px]; each replaces that of the file.
    """

    file: str | Path | None = None
    fx: float | None = None
    fy: float | None = None
    cx: float | None = None
    cy: float | None = None

    def camera(self, size: tuple[int, int], where: str) -> Camera:
        """The camera of images of this (height, width).

        Raises:
            InputError: something is missing, cannot be understood, or belongs to images of another size.
        """
        names = ("fx", "fy", "cx", "cy")
        found = dict.fromkeys(names) if self.file is None else _read(Path(self.file), size)
        values: dict[str, Any] = {**found, **{k: v for k in names if (v := getattr(self, k)) is not None}}
        missing = [name for name in names if values[name] is None]
        if missing:
            got = f"no {', '.join(missing)}"
            raise InputError("Camera intrinsics are missing", where=where, expected=_EXPECTED, got=got)
        fx, fy, cx, cy = (float(values[name]) for name in names)
        return Camera(fx, fy, cx, cy, height=size[0], width=size[1])


def _declared_size(description: Mapping[str, Any]) -> list[int] | None:
    """Height and width of the images that a camera belongs to [px]; None where nothing says them."""
    sides = description.get("image_size")
    if sides is None and {"height", "width"} & set(description):
        sides = [description["height"], description["width"]]
    return None if sides is None else [int(value) for value in sides]


def _read(path: Path, size: tuple[int, int]) -> dict[str, Any]:
    if not path.is_file():
        raise InputError("Camera file is missing", where=str(path), expected=_EXPECTED, got="no such file")
    try:
        description = read_json_object(path)
        if "K" in description:
            (fx, skew, cx), (lower, fy, cy), _ = description["K"]
            if skew or lower:
                raise ValueError("skew is not supported")
        else:
            (fx, fy), (cx, cy) = description["focal_length"], description["optical_center"]
        numbers = [float(value) for value in (fx, fy, cx, cy)]
        if not all(map(math.isfinite, numbers)):
            raise ValueError("not finite")
        declared = _declared_size(description) or list(size)
    except (ValueError, KeyError, TypeError) as error:
        got = f"{type(error).__name__}: {error}"
        raise InputError(
            "Camera file cannot be understood", where=str(path), expected=_EXPECTED, got=got
        ) from error
    if declared != list(size):
        raise InputError(
            "Camera belongs to images of another size",
            where=str(path),
            expected=f"{size[0]} x {size[1]} px (height x width), as rgb_000.png",
            got=f"{' x '.join(map(str, declared))}; intrinsics must be scaled with the images",
        )
    return dict(zip(("fx", "fy", "cx", "cy"), numbers, strict=True))
