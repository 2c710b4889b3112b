"""The scene that a run belongs to."""

from __future__ import annotations

from typing import Any

from omegaconf import DictConfig

from toile.cli.configuration import instantiate, scene_settings
from toile.reports.run_folder import RunFolder, read_config
from toile.scenes.scene import Scene


def run_scene(cfg: DictConfig, folder: RunFolder, **changes: Any) -> Scene:
    """Load the scene the command names, else the one the run was made with.

    Args:
        cfg: configuration of the command, with ``paths`` and perhaps ``scene``.
        folder: the run.
        changes: settings of the scene to replace, e.g. ``n_frames=1``.

    Raises:
        InputError: neither names a scene, or it cannot be loaded.
    """
    text = "" if cfg.get("scene") is not None else read_config(folder)
    scene: Scene = instantiate({**scene_settings(cfg, text, folder.config), **changes})
    return scene
