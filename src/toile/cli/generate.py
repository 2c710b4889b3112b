"""``toile generate``: a synthetic scene with known truth, in the native layout."""

from __future__ import annotations

import logging
from pathlib import Path

from omegaconf import DictConfig

from toile.cli.configuration import instantiate
from toile.cli.terminal import print_path
from toile.errors import InputError
from toile.generation.generator import generate
from toile.generation.truth import write
from toile.progress import Shown
from toile.scenes.registry import load_template

log = logging.getLogger(__name__)


def run(cfg: DictConfig) -> None:
    """Simulate, render, write the folder and print its path."""
    print_path(written_scene(cfg))


def written_scene(cfg: DictConfig) -> Path:
    """Simulate, render and write a scene; returns its folder."""
    folder = Path(cfg.folder)
    if folder.exists() and not cfg.overwrite:
        # Said before minutes of simulation, not after.
        raise InputError(
            "Scene folder exists already",
            where=str(folder),
            expected="a folder that does not exist, another folder=..., or overwrite=true",
            got="an existing file or folder",
        )
    template = None if cfg.template is None else load_template(str(cfg.template), cfg.paths.data)
    with Shown(log) as progress:
        scene, truth = generate(
            instantiate(cfg.settings), instantiate(cfg.texture), template, report=progress
        )
        progress("writing", 0, None)
        write(scene, truth, folder, overwrite=cfg.overwrite)
    return folder
