"""``toile masks video=<file> scene=<folder>``: frames and masks, the first step from a video to a scene."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from rich.text import Text

from toile.atomic_file import written_atomically
from toile.cli.configuration import instantiate
from toile.cli.terminal import console, print_path
from toile.preparation.segmentation.base import Segmentation
from toile.preparation.segmentation.checks import MaskMeasures, check_sequence
from toile.preparation.segmentation.writing import FOLDERS, write_frames
from toile.preparation.video import DESCRIPTION, open_clip
from toile.progress import Shown, counted
from toile.reports.mask_pictures import mask_picture, rulers
from toile.reports.overlay import Picture, write_video
from toile.scenes.atomic_folder import entries_written_atomically
from toile.scenes.findings import Finding, Severity
from toile.scenes.frame_times import check_number_of_frames
from toile.scenes.images import read_mask, read_rgb, write_levels
from toile.scenes.native import FILES
from toile.scenes.picture_checks import PictureChecks

log = logging.getLogger(__name__)

PREVIEW = "masks.mp4"
TIMES = ("recorded", "uniform")
NAMES = (*FOLDERS, DESCRIPTION, PREVIEW, "masks.gif")
"""What a folder may hold from an earlier call; the last where no video encoder is found."""


def run(cfg: DictConfig) -> None:
    """Decode, segment and write; print warnings and paths."""
    clip = open_clip(
        Path(str(cfg.video)), start=cfg.start, n_frames=cfg.n_frames, every=cfg.every, fps=cfg.fps
    )
    if cfg.times == "uniform":
        clip = clip.evenly_spaced(cfg.uniform_tolerance)
    if cfg.still is not None:
        with closing(clip.frames()) as frames, written_atomically(Path(cfg.still)) as file:
            write_levels(file, rulers(next(frames)))
        print_path(cfg.still)
        return
    folder = Path(str(cfg.scene.name))
    method: Segmentation = instantiate(cfg.method)
    checks = PictureChecks(clip.expected_frames)
    with (
        Shown(log) as progress,
        entries_written_atomically(folder, NAMES, overwrite=cfg.overwrite) as new,
    ):
        segmented = counted(method.masks(clip.frames()), progress, "masks", clip.expected_frames)
        measures = write_frames(new, clip, segmented, _notes(cfg), checks)
        pictures = counted(_preview(new, measures, cfg.preview_height), progress, PREVIEW, len(measures))
        preview = write_video(pictures, new / PREVIEW, clip.fps)
    out = console()
    findings = [
        *clip.remarks,
        *check_number_of_frames(len(measures), str(folder)),
        *checks.findings(str(folder)),
        *check_sequence(measures, cfg.largest_jump, str(folder)),
        *_earlier_template(folder),
    ]
    for finding in findings:
        out.print(Text(str(finding), style="yellow"))
    mean = "" if clip.times is None else " on average, each with its own time in video.json"
    out.print(f"{len(measures)} frames of {clip.width} x {clip.height} px, {clip.fps:g} per second{mean}")
    print_path(folder / DESCRIPTION)
    print_path(folder / preview.name)


def _preview(folder: Path, measures: Sequence[MaskMeasures], height: int) -> Iterator[Picture]:
    """Pictures of what was written, cut to where the cloth is in any frame and a quarter more."""
    boxes = [m.box for m in measures]
    margin = max(max(b.height, b.width) for b in boxes) // 4
    top, left = max(min(b.top for b in boxes) - margin, 0), max(min(b.left for b in boxes) - margin, 0)
    bottom = max(b.top + b.height for b in boxes) + margin
    right = max(b.left + b.width for b in boxes) + margin
    for number in range(len(measures)):
        frame, mask = read_rgb(folder / (FILES["rgb"] % number)), read_mask(folder / (FILES["mask"] % number))
        frame, mask = (picture[top:bottom, left:right] for picture in (frame, mask))
        yield mask_picture(frame.numpy(), mask.numpy() > 0, height, f"frame {number}")


def _earlier_template(folder: Path) -> list[Finding]:
    """A warning if a template, which belongs to the first frame, is older than that frame."""
    if not (folder / FILES["template"]).exists():
        return []
    return [
        Finding(
            Severity.WARNING,
            "Template was made from other frames or masks",
            str(folder / FILES["template"]),
            "toile template after toile masks",
            "an older file",
        )
    ]


def _notes(cfg: DictConfig) -> dict[str, Any]:
    """How the masks were made, for video.json."""
    method = _without_targets(OmegaConf.to_container(cfg.method, resolve=True))
    return {
        "method": HydraConfig.get().runtime.choices["method"],
        "settings": {"start": cfg.start, "every": cfg.every, "times": cfg.times, **method},
    }


def _without_targets(node: Any) -> Any:
    if isinstance(node, dict):
        return {key: _without_targets(value) for key, value in node.items() if key != "_target_"}
    return node
