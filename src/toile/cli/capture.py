"""``toile capture ACTION``: people in moving garments, data of them, and networks that reconstruct them."""

from __future__ import annotations

import json
import logging
from pathlib import Path

from omegaconf import DictConfig

from toile.atomic_file import write_text
from toile.capture.data.clips import TRUTH_FILE, Truth
from toile.capture.data.making import clips_of, make_data
from toile.cli.configuration import instantiate
from toile.cli.terminal import print_path
from toile.errors import InputError
from toile.progress import Shown
from toile.workers import Workers, processes

DIAGNOSIS_FILE = "diagnosis.json"

log = logging.getLogger(__name__)


def run(cfg: DictConfig) -> None:
    """Do what the plain argument says.

    Raises:
        InputError: no such action.
    """
    actions = {"data": _data, "page": _page, "export": _export, "run": _run, "tables": _tables}
    actions |= {"diagnose": _diagnose}
    actions |= dict.fromkeys(("pose", "warm", "physics", "adapt"), _train)
    if str(cfg.action) not in actions:
        raise InputError(
            "No such action", where="toile capture", expected=", ".join(actions), got=str(cfg.action)
        )
    if cfg.dry_run and str(cfg.action) != "data":
        raise InputError("Nothing to try", where="dry_run", expected="false, but for data", got="true")
    actions[str(cfg.action)](cfg)


def _data(cfg: DictConfig) -> None:
    """Make a data set, or complete one; or say only what it would be."""
    domain = instantiate(cfg.domain)
    if cfg.dry_run:
        print("\n".join(domain.estimate().lines()))
        return
    with Shown(log) as progress, Workers(processes(int(cfg.workers))) as workers:
        print_path(make_data(domain, Path(str(cfg.folder)), progress, workers))


def _page(cfg: DictConfig) -> None:
    """One page per clip."""
    from toile.reports.page.capture_page import write_capture_page

    for clip in clips_of(Path(str(cfg.run))):
        with Shown(log) as progress:
            print_path(write_capture_page(clip, view=int(cfg.view), every=int(cfg.every), report=progress))


def _train(cfg: DictConfig) -> None:
    """Stages of the training."""
    from toile.cli.capture_training import adapt, train

    if str(cfg.action) == "adapt":
        adapt(cfg)
    else:
        train(cfg, str(cfg.action))


def _run(cfg: DictConfig) -> None:
    """Body and garment from one camera."""
    from toile.cli.capture_run import run_clips

    run_clips(cfg)


def _diagnose(cfg: DictConfig) -> None:
    """What the model of every clip lacks, from one camera's masks."""
    from toile.diagnosis.garment.recording import diagnose_clip

    settings = instantiate(cfg.diagnosis)
    n_frames = None if cfg.n_frames is None else int(cfg.n_frames)
    for clip in clips_of(Path(str(cfg.run))):
        with Shown(log) as progress:
            found = diagnose_clip(clip, int(cfg.view), n_frames, settings, progress)
        print_path(write_text(clip / DIAGNOSIS_FILE, json.dumps(found, indent=1) + "\n"))
        sure = "" if found["calibrated"] else " (uncalibrated)"
        print(f"{clip.name}: {found['answer']}{sure}; candidates {', '.join(found['candidates'])}")


def _tables(cfg: DictConfig) -> None:
    """What is trained against what it is compared with."""
    from toile.cli.capture_tables import write_tables

    write_tables(cfg)


def _export(cfg: DictConfig) -> None:
    """One file per clip, of body and garment."""
    from toile.export.animation import MeshAnimation
    from toile.export.formats import export_meshes

    for clip in clips_of(Path(str(cfg.run))):
        truth = Truth.load(clip / TRUTH_FILE)
        meshes = (
            MeshAnimation(truth.body_positions, truth.body_faces, truth.fps, "body"),
            MeshAnimation(truth.garment_positions, truth.garment_faces, truth.fps, "garment"),
        )
        print_path(export_meshes(meshes, clip, str(cfg.format)))
