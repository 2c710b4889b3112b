"""Reading and writing PNG images and numbered image sequences, with errors that name the file."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from toile.errors import InputError

_ON_ITS_SIDE = (5, 6, 7, 8)
"""Orientations in EXIF by which height and width of what is stored are exchanged."""


def read_rgb(path: Path) -> Tensor:
    """Read an image as (h, w, 3) uint8; grey and palette images are converted, alpha is dropped.

    Raises:
        InputError: the file is missing, truncated or no image.
    """
    return torch.from_numpy(_decode(path, "RGB"))


def read_mask(path: Path) -> Tensor:
    """Read a mask as (h, w) uint8, 0 outside and 255 inside.

    Raises:
        InputError: the file is missing, truncated or no image.
    """
    return torch.from_numpy(_decode(path, "L"))


def write_image(path: Path, image: Tensor) -> None:
    """Write (h, w, 3) or (h, w) in [0, 1] as an 8-bit PNG, rounded to the nearest level."""
    write_levels(path, (image.detach().cpu().clamp(0, 1) * 255).round().to(torch.uint8).numpy())


def write_levels(path: Path, levels: npt.NDArray[np.uint8]) -> None:
    """Write (h, w, 3) or (h, w), uint8, as a PNG."""
    from PIL import Image

    Image.fromarray(levels).save(path, compress_level=4)


def image_size(path: Path) -> tuple[int, int]:
    """(height, width) of an image [px], from its header alone.

    Raises:
        InputError: the file is missing or no image.
    """
    from PIL import ExifTags, Image

    try:
        with Image.open(path) as image:
            # Of a PNG without any it would be looked for behind the whole image.
            said = image.format != "PNG" or "exif" in image.info
            turned = said and image.getexif().get(ExifTags.Base.Orientation, 1) in _ON_ITS_SIDE
            return (image.width, image.height) if turned else (image.height, image.width)
    except FileNotFoundError as error:
        raise _missing(path) from error
    except Exception as error:
        raise _unreadable(path, error) from error


def numbered_files(folder: Path, prefix: str, suffix: str = ".png") -> dict[int, Path]:
    """Files ``<prefix><digits><suffix>`` of a folder by their number, in increasing order."""
    if not folder.is_dir():
        return {}
    pattern = re.compile(re.escape(prefix) + r"(\d+)" + re.escape(suffix))
    found = {int(m[1]): p for p in folder.iterdir() if (m := pattern.fullmatch(p.name))}
    return dict(sorted(found.items()))


def _decode(path: Path, mode: str) -> np.ndarray:
    from PIL import Image, ImageOps

    try:
        with Image.open(path) as image:
            # Photos of a camera held upright are stored on their side, and say so.
            image.load()
            ImageOps.exif_transpose(image, in_place=True)
            # Converting to the mode that it has would copy it.
            return np.array(image if image.mode == mode else image.convert(mode))
    except FileNotFoundError as error:
        raise _missing(path) from error
    except Exception as error:
        raise _unreadable(path, error) from error


def _missing(path: Path) -> InputError:
    there = sorted(p.name for p in path.parent.iterdir()) if path.parent.is_dir() else None
    if there is None:
        got = f"no folder {path.parent}"
    elif not there:
        got = "an empty folder"
    else:
        got = f"{len(there)} files there, {there[0]} to {there[-1]}, but not this one"
    return InputError(f"Image {path.name} is missing", where=str(path), expected="an image file", got=got)


def _unreadable(path: Path, error: Exception) -> InputError:
    size = path.stat().st_size if path.exists() else 0
    return InputError(
        f"Image {path.name} is unreadable or truncated",
        where=str(path),
        expected="a complete image file",
        got=f"{size} bytes; {type(error).__name__}: {error}",
    )
