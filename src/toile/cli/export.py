"""``toile export run=<run folder> format=usd``: the trajectory for other programs."""

from __future__ import annotations

from pathlib import Path

from omegaconf import DictConfig, ListConfig

from toile.cli.run_scene import run_scene
from toile.cli.terminal import print_path
from toile.errors import InputError
from toile.export.animation import ClothAnimation
from toile.export.formats import FORMATS, export_animation
from toile.reports.run_folder import open_run_folder, read_trajectory


def run(cfg: DictConfig) -> None:
    """Write one or more formats and print where they are."""
    formats = list(cfg.format) if isinstance(cfg.format, ListConfig) else [cfg.format]
    unknown = [str(name) for name in formats if name not in FORMATS]
    if unknown:
        # Before anything is loaded or written.
        raise InputError(
            "Unknown export format", where="format", expected=", ".join(FORMATS), got=", ".join(unknown)
        )
    folder = open_run_folder(Path(cfg.run))
    trajectory = read_trajectory(folder)
    # The texture is that of the first frame or of the template, so no other frame needs to be read.
    scene = run_scene(cfg, folder, trajectory, n_frames=1) if cfg.texture else None
    animation = ClothAnimation(
        trajectory.positions,
        trajectory.fps,
        None if scene is None else scene.texture_coordinates.numpy(),
        None if scene is None else scene.texture.numpy(),
        times=trajectory.uneven_times,
    )
    for name in formats:
        written = export_animation(animation, Path(cfg.folder), name, keep_camera_frame=cfg.keep_camera_frame)
        print_path(written[0], f" and {len(written) - 1} more" if len(written) > 1 else "")
