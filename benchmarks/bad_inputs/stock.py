"""What cases start from: a scene, a clip, runs and a blind set, all small, all made by toile itself.

::

    data/made/cloth       a scene with ground truth: 8 x 8 vertices, 12 frames of 96 x 96 px
    run/                  a finished fit of it
    half/                 the same, interrupted
    training/             an interrupted training of the surrogate
    clip.mp4, video/      an orange square that moves before black; the folder that toile masks makes of it
    sheet/                frames and masks of a flat cloth, without template
    scan.ply              its points
    outputs/blind*/       a blind set of three scenes, made, not run
"""

from __future__ import annotations

import json
import shutil
import time
from pathlib import Path

import numpy as np

from bad_inputs.processes import start

SCENE = "data/made/cloth"
RUN, HALF, TRAINING, VIDEO, SHEET = "run", "half", "training", "video", "sheet"
GENERATE = (
    "generate",
    "settings.grid=[8,8]",
    "settings.refinement=1",
    "settings.cloth_size=[0.4,0.4]",
    "settings.n_frames=12",
    "settings.substeps=2",
    "settings.image_size=[96,96]",
    "settings.focal_length=140",
    "texture.height=96",
    "texture.width=96",
)
# Small where size says nothing; whatever a user would leave alone is left alone.
QUICK = ("optimization.stages.track.term.per_side=24",)
FIT = ("fit", "scene=cloth", *QUICK)
SHORT = (
    "fit",
    "scene=cloth",
    "experiment=paper",
    "optimization.cycles=4",
    "scene.n_frames=6",
    "optimization.first_frames=3",
)
LONG = (
    "fit",
    "scene=cloth",
    "experiment=paper",
    "scene.n_frames=6",
    "optimization.first_frames=3",
    "callbacks.checkpoint.every=1",
    "report.video=false",
    "logger=none",
)
TRAIN = ("train", "training=tiny", "threads=1")
DIAGNOSE = (
    "diagnose",
    "scene=cloth",
    "diagnosis=quick",
    "diagnosis.sides=[8]",
    "diagnosis.shooting.modes=2",
    "diagnosis.shooting.window=4",
    "workers=1",
    *QUICK,
)
BLIND = (
    "blind=tiny",
    "out_of_family.grid=[6,6]",
    "out_of_family.n_frames=6",
    "out_of_family.substeps=3",
    "out_of_family.image_side=40",
    "out_of_family.texture_side=40",
    "out_of_family.largest_grid_share=20",
    "first=3",
)
BLIND_SET, BLIND_KEY = "outputs/blind/tiny", "outputs/blind_keys/tiny.blindkey"


def make_stock(folder: Path) -> Path:
    """Make it, unless it is there."""
    done = folder / "complete"
    if done.is_file():
        return folder
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    _clip(folder)
    _sheet(folder)
    _toile(folder, *GENERATE, f"folder={SCENE}")
    _toile(folder, *SHORT, f"hydra.run.dir={RUN}")
    _interrupted(folder, HALF, *LONG, "optimization.cycles=6")
    _interrupted(folder, TRAINING, *TRAIN, "callbacks.checkpoint.every=1", "training.epochs=100000")
    _toile(folder, "masks", "video=clip.mp4", f"scene={VIDEO}", "method=dark_background")
    _toile(folder, "blind", "make", *BLIND)
    done.touch()
    return folder


def _toile(folder: Path, *arguments: str) -> None:
    answer = start(arguments, folder, folder / "command", {"TOILE_DATA": ""}, process=False).wait(300)
    if answer.status != 0:
        raise RuntimeError(f"toile {' '.join(arguments)}: {answer.status}\n{answer.err[-3000:]}")


def _interrupted(folder: Path, run: str, *arguments: str) -> None:
    """Run until there is a checkpoint, then Ctrl-C."""
    command = start(
        (*arguments, f"hydra.run.dir={run}"), folder, folder / "command", {"TOILE_DATA": ""}, process=False
    )
    checkpoint = folder / run / "checkpoints" / "last.ckpt"
    until = time.monotonic() + 120
    while not checkpoint.is_file() and not command.has_ended() and time.monotonic() < until:
        time.sleep(0.005)
    if not command.has_ended():
        command.interrupt()
    answer = command.wait(300)
    if answer.status != 130 or not checkpoint.is_file():
        raise RuntimeError(f"toile {' '.join(arguments)}: {answer.status}\n{answer.err[-3000:]}")


def _clip(folder: Path) -> None:
    import imageio.v3 as iio

    frames = np.zeros((6, 48, 64, 3), np.uint8)
    for k in range(len(frames)):
        frames[k, 12:36, 14 + 2 * k : 38 + 2 * k] = (220, 140, 60)
        frames[k, 22:26, 24 + 2 * k : 28 + 2 * k] = 0
    iio.imwrite(folder / "clip.mp4", frames, plugin="FFMPEG", fps=20, quality=9, macro_block_size=2)


def _sheet(folder: Path) -> None:
    """A flat cloth of 0.5 m x 0.4 m, 1 m in front of a camera with f = 200 px."""
    from PIL import Image

    top = folder / SHEET
    noise = np.random.default_rng(0)
    mask = np.zeros((120, 160), np.uint8)
    mask[20:100, 30:130] = 255
    for name in ("rgbs", "masks"):
        (top / name).mkdir(parents=True)
    for k in range(3):
        frame = noise.integers(0, 256, (120, 160, 3), dtype=np.uint8)
        Image.fromarray(frame).save(top / "rgbs" / f"rgb_{k:03d}.png")
        Image.fromarray(mask).save(top / "masks" / f"mask_{k:03d}.png")
    (top / "video.json").write_text(json.dumps({"fps": 30.0, "width": 160, "height": 120}))
    x, y = np.meshgrid(np.linspace(-0.25, 0.25, 40), np.linspace(-0.2, 0.2, 40), indexing="ij")
    points = np.stack((x, y, np.ones_like(x)), -1).reshape(-1, 3)
    rows = "\n".join(" ".join(f"{v:.5f}" for v in p) for p in points)
    head = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n"
    head += "property float x\nproperty float y\nproperty float z\nend_header\n"
    (folder / "scan.ply").write_text(head + rows + "\n")
    (folder / "camera.json").write_text(json.dumps({"K": [[200, 0, 80], [0, 200, 60], [0, 0, 1]]}))
