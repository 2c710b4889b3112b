"""``toile masks video=<file> scene=<folder>``: frames and masks, the first step from a video to a scene."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.progress import track
from rich.text import Text

from toile.cli.configuration import instantiate
from toile.cli.terminal import console, print_path
from toile.reports.mask_pictures import mask_picture
from toile.reports.overlay import Picture, write_video
from toile.scenes.atomic_folder import entries_written_atomically
from toile.scenes.findings import Finding, Severity
from toile.scenes.native import FILES
from toile.scenes.segmentation.base import Segmentation, Segmented
from toile.scenes.segmentation.checks import check_sequence
from toile.scenes.segmentation.writing import DESCRIPTION, FOLDERS, write_frames
from toile.scenes.video import open_clip

PREVIEW = "masks.mp4"
NAMES = (*FOLDERS, DESCRIPTION, PREVIEW, "masks.gif")
"""What a folder may hold from an earlier call; the last where no video encoder is found."""


def run(cfg: DictConfig) -> None:
    """Decode, segment and write; print warnings and paths."""
    folder = Path(str(cfg.scene.name))
    clip = open_clip(
        Path(str(cfg.video)), start=cfg.start, n_frames=cfg.n_frames, every=cfg.every, fps=cfg.fps
    )
    method: Segmentation = instantiate(cfg.method)
    pictures: list[Picture] = []
    with entries_written_atomically(folder, NAMES, overwrite=cfg.overwrite) as new:
        segmented = _pictured(method.masks(clip.frames()), pictures, cfg.preview_height)
        measures = write_frames(new, clip, _with_progress(segmented, clip.expected_frames), _notes(cfg))
        preview = write_video(pictures, new / PREVIEW, clip.fps)
    out = console()
    findings = check_sequence(measures, cfg.largest_jump, str(folder))
    for finding in [*findings, *_earlier_template(folder)]:
        out.print(Text(str(finding), style="yellow"))
    out.print(f"{len(measures)} frames of {clip.width} x {clip.height} px, {clip.fps:g} per second")
    print_path(folder / DESCRIPTION)
    print_path(folder / preview.name)


def _pictured(segmented: Iterable[Segmented], pictures: list[Picture], height: int) -> Iterator[Segmented]:
    for number, found in enumerate(segmented):
        pictures.append(mask_picture(*found, height, f"frame {number}"))
        yield found


def _with_progress(segmented: Iterable[Segmented], total: int | None) -> Iterable[Segmented]:
    terminal = Console(stderr=True)
    return track(
        segmented, "masks", total=total, console=terminal, disable=not terminal.is_terminal, transient=True
    )


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
        "settings": {"start": cfg.start, "every": cfg.every, **method},
    }


def _without_targets(node: Any) -> Any:
    if isinstance(node, dict):
        return {key: _without_targets(value) for key, value in node.items() if key != "_target_"}
    return node
