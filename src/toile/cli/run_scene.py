"""The scene that a run belongs to."""

from __future__ import annotations

from typing import Any

import torch
from omegaconf import DictConfig

from toile.cli.configuration import instantiate, scene_settings
from toile.reports.run_folder import RunFolder, SavedTrajectory, read_config
from toile.scenes.scene import Scene

TEXTURE_OFFSET = "texture offset"
"""Name under which a fit saves what it added to the texture coordinates (H, W, 2)."""


def run_scene(
    cfg: DictConfig, folder: RunFolder, trajectory: SavedTrajectory | None = None, **changes: Any
) -> Scene:
    """Load the scene the command names, else the one the run was made with.

    Args:
        cfg: configuration of the command, with ``paths`` and perhaps ``scene``.
        folder: the run.
        trajectory: its texture coordinates replace those of the scene, if it has fitted them.
        changes: settings of the scene to replace, e.g. ``n_frames=1``.

    Raises:
        InputError: neither names a scene, or it cannot be loaded.
    """
    text = "" if cfg.get("scene") is not None else read_config(folder)
    scene: Scene = instantiate({**scene_settings(cfg, text, folder.config), **changes})
    offset = None if trajectory is None else trajectory.parameters.get(TEXTURE_OFFSET)
    if offset is None or offset.shape != tuple(scene.texture_coordinates.shape):
        return scene
    return scene.with_texture_offset(torch.from_numpy(offset))
