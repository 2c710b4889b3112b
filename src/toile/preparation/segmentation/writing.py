"""Frames and masks of a clip as the beginning of a scene in the native layout."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from toile.preparation.segmentation.base import Segmented
from toile.preparation.segmentation.checks import MaskMeasures, measure
from toile.preparation.video import DESCRIPTION, Clip
from toile.scenes.images import write_levels
from toile.scenes.native import FILES
from toile.scenes.picture_checks import PictureChecks

FOLDERS = tuple(str(Path(FILES[key]).parent) for key in ("rgb", "mask"))


def write_frames(
    folder: Path,
    clip: Clip,
    segmented: Iterable[Segmented],
    notes: Mapping[str, Any],
    checks: PictureChecks | None = None,
) -> list[MaskMeasures]:
    """Write rgbs/, masks/ and video.json into an existing folder.

    Args:
        folder: target.
        clip: where the frames come from.
        segmented: its frames with their masks, in order.
        notes: what else video.json shall say, beside fps, times (where frames are unevenly spaced), width,
            height, frames and source (a file name).
        checks: looks at every frame and mask.

    Returns:
        What the checks need to know of every mask.
    """
    for name in FOLDERS:
        (folder / name).mkdir()
    measures = []
    for number, (frame, mask) in enumerate(segmented):
        write_levels(folder / (FILES["rgb"] % number), frame)
        write_levels(folder / (FILES["mask"] % number), np.where(mask, 255, 0).astype(np.uint8))
        measures.append(measure(mask))
        if checks is not None:
            checks.add(frame, mask)
    description = {
        "fps": clip.fps,
        **({} if clip.times is None else {"times": list(clip.times)}),
        "width": clip.width,
        "height": clip.height,
        "frames": len(measures),
        "source": clip.path.resolve().name,
        **notes,
    }
    (folder / DESCRIPTION).write_text(json.dumps(description, indent=1) + "\n")
    return measures
