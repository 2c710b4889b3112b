"""``toile capture run``: body and garment from one camera, with trained networks."""

from __future__ import annotations

import json
import logging
from pathlib import Path

from omegaconf import DictConfig

from toile.atomic_file import write_text
from toile.capture.body.subject import Subject
from toile.capture.data.clips import TRUTH_FILE
from toile.capture.garments.garment import Garment
from toile.capture.metrics.reconstruction import MeasuredClip
from toile.capture.prediction import predict
from toile.capture.test_time.finish import FinishSettings, finish
from toile.capture.test_time.own_clip import OwnCamera, write_own_clip
from toile.capture.test_time.resolution import CollisionResolution
from toile.capture.training.frames import camera_frames
from toile.capture.training.weights import Networks, load_networks
from toile.cli.configuration import instantiate
from toile.cli.terminal import print_path
from toile.errors import InputError
from toile.export.animation import MeshAnimation
from toile.export.formats import export_meshes
from toile.preparation.video import open_clip
from toile.progress import Shown
from toile.rendering.warp.renderer import WarpRenderer
from toile.scenes.multi_view import load_multi_view
from toile.scenes.views import MultiView

log = logging.getLogger(__name__)

PREDICTION_FILE, MOTION_FILE, MEASURES_FILE = "prediction.npz", "motion.npz", "measures.json"


def run_clips(cfg: DictConfig) -> None:
    """Reconstruct a clip, every clip of a data set, or a video of one's own.

    Raises:
        InputError: see ``load_networks``, ``write_own_clip``, ``camera_frames``.
    """
    settings: FinishSettings = instantiate(cfg.finish)
    networks = load_networks(None if cfg.weights is None else Path(str(cfg.weights)))
    result = Path(str(cfg.result))
    resolution = CollisionResolution(networks.garment, networks.subject, settings.resolution)
    folders = [_own(cfg, networks, result)] if cfg.video is not None else _recordings(Path(str(cfg.run)))
    for folder in folders:
        place = result / folder.name if cfg.video is None else result
        for path in _one(cfg, networks, folder, place, settings, resolution):
            print_path(path)


def _own(cfg: DictConfig, networks: Networks, result: Path) -> Path:
    """The recording of a video, made anew."""
    for name in ("masks", "landmarks"):
        if cfg[name] is None:
            raise InputError(
                "A video alone is not enough",
                where=name,
                expected=f"{name}=<path>; see toile capture run in docs/capture.md",
                got="none",
            )
    clip = open_clip(Path(str(cfg.video)), n_frames=cfg.n_frames, fps=cfg.fps)
    camera: OwnCamera = instantiate(cfg.camera)
    with Shown(log) as progress:
        return write_own_clip(
            clip.evenly_spaced(0.1),
            Path(str(cfg.masks)),
            Path(str(cfg.landmarks)),
            camera,
            networks.subject.landmark_names,
            result / "recording",
            progress,
        )


def _recordings(folder: Path) -> list[Path]:
    """A recording, or the clips of a data set."""
    from toile.capture.data.making import DATA_FILE, clips_of

    return clips_of(folder) if (folder / DATA_FILE).is_file() else [folder]


def _one(
    cfg: DictConfig,
    networks: Networks,
    folder: Path,
    place: Path,
    settings: FinishSettings,
    resolution: CollisionResolution,
) -> list[Path]:
    """Files of one clip: page, animation, prediction, motion, and measures where the truth is known."""
    from toile.reports.page.capture_page import PAGE_FILE, write_prediction_page

    recording: MultiView = load_multi_view(folder)
    view = int(cfg.view)
    with Shown(log) as progress:
        frames = camera_frames(
            recording, view, networks.subject.landmark_names, networks.settings.backbone.side, progress
        )
        progress("reconstructing", 0, None)
        stated = predict(networks.pose_net, networks.sim_net, frames, networks.deformation)
        found = finish(stated, networks.deformation, settings, resolution)
        motion = found.motion(networks.deformation)
        place.mkdir(parents=True, exist_ok=True)
        written = [stated.save(place / PREDICTION_FILE), motion.save(place / MOTION_FILE)]
        written.append(
            write_prediction_page(
                motion,
                recording,
                networks.subject,
                networks.garment,
                place / PAGE_FILE,
                name=folder.name,
                view=view,
                every=int(cfg.every),
                report=progress,
            )
        )
        meshes = (
            MeshAnimation(motion.body_positions, motion.body_faces, motion.fps, "body"),
            MeshAnimation(motion.garment_positions, motion.garment_faces, motion.fps, "garment"),
        )
        written.append(export_meshes(meshes, place, str(cfg.format)))
        if (folder / TRUTH_FILE).is_file():
            networks.check_belongs(*_shared(folder), where=str(folder))
            clip = MeasuredClip.load(folder, WarpRenderer(2), view, int(cfg.every))
            measures = {
                name: clip.measure(found.reconstruction(resolved=resolved)).to_dict()
                for name, resolved in (("before_resolution", False), ("after_resolution", True))
            }
            written.append(write_text(place / MEASURES_FILE, json.dumps(measures, indent=1) + "\n"))
    return written


def _shared(clip: Path) -> tuple[Subject, Garment]:
    return Subject.load(clip.parent / "subject.npz"), Garment.load(clip.parent / "garment.npz")
