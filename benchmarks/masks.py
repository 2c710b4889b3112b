"""How well `toile masks` cuts a cloth out of a clip: IoU with known masks, and time.

    python benchmarks/masks.py              # generated clips, and R1 where the data folder has it
    python benchmarks/masks.py --frames 8   # only the first ones of R1 before a wall

The true masks come with R1 and with generated scenes. R1's frames show the cloth on black; for a harder clip
its cloth, or a generated one, is put before a wall (plain, or cluttered with shapes in all colours), with the
noise of a sensor, and compressed as a telephone does. Box and polygon are what a person would mark in frame
0: the box 5 % larger than the cloth, the polygon's few corners off by 1 % of its size. The settings are the
defaults, which were chosen on other generated clips, not on these. Writes docs/results/masks.md; clips and
masks go to outputs/masks, which is not part of the repository.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import cv2
import imageio.v3 as iio
import numpy as np
import pandas as pd
from results import ROOT, toile

from toile.cli.machine import machine
from toile.scenes.images import numbered_files, read_mask, read_rgb
from toile.scenes.masks import drop_small_components
from toile.scenes.registry import data_folder

SEED = 11
NOISE = 3.0  # levels of 255
FPS = 50


class Source(NamedTuple):
    """A clip with known masks: files of frames and masks, and the name in the table."""

    name: str
    frames: list[Path]
    masks: list[Path]

    def true_mask(self, k: int) -> np.ndarray:
        """Of the cloth alone: R1's masks also show two feet."""
        return drop_small_components(read_mask(self.masks[k]), 0.1)[0].numpy() > 127


def wall(h: int, w: int, *, cluttered: bool) -> np.ndarray:
    """A wall (h, w, 3) in levels of 255: rough plaster, or shapes in all colours."""
    rng = np.random.default_rng(SEED)
    picture = np.zeros((h, w, 3), np.float32) + rng.uniform(90, 170, 3).astype(np.float32)
    for cells in (270, 68, 17, 5):
        coarse = rng.normal(size=(cells, cells * w // h, 3)).astype(np.float32)
        layer = cv2.resize(coarse, (w, h), interpolation=cv2.INTER_CUBIC)
        picture += layer / layer.std() * (12 if cluttered else 3)
    for _ in range(60 if cluttered else 0):
        colour, x, y = rng.uniform(20, 230, 3).tolist(), int(rng.integers(w)), int(rng.integers(h))
        a, b = int(rng.integers(w // 40, w // 6)), int(rng.integers(h // 40, h // 4))
        if rng.random() < 0.5:
            cv2.rectangle(picture, (x, y), (x + a, y + b), colour, -1)
        else:
            cv2.ellipse(picture, (x, y), (a, b), float(rng.uniform(0, 180)), 0, 360, colour, -1)
    return cv2.GaussianBlur(picture, (0, 0), 1.0)


def film(source: Source, background: np.ndarray, path: Path) -> None:
    """The source's cloth before another background, as a compressed video."""
    rng = np.random.default_rng(SEED)
    frames = []
    for k, file in enumerate(source.frames):
        soft = cv2.GaussianBlur(source.true_mask(k).astype(np.float32), (0, 0), 0.8)[..., None]
        picture = soft * read_rgb(file).numpy() + (1 - soft) * background
        picture += NOISE * rng.normal(size=picture.shape)
        frames.append(picture.round().clip(0, 255).astype(np.uint8))
    iio.imwrite(path, np.stack(frames), plugin="FFMPEG", fps=FPS, quality=8, macro_block_size=2)


def box(mask: np.ndarray) -> str:
    """The setting that marks a mask by a box 5 % larger than it."""
    x, y, w, h = cv2.boundingRect(mask.astype(np.uint8))
    grow = round(0.05 * max(w, h))
    corners = (x - grow, y - grow, x + w + grow, y + h + grow)
    limits = (mask.shape[1], mask.shape[0]) * 2
    values = [min(max(value, 0), limit) for value, limit in zip(corners, limits, strict=True)]
    return f"method.box={values}".replace(" ", "")


def polygon(mask: np.ndarray) -> str:
    """The setting that marks a mask by its few corners, off by 1 % of its size."""
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    size = np.sqrt(mask.sum())
    corners = cv2.approxPolyDP(max(contours, key=cv2.contourArea), 0.03 * size, closed=True).reshape(-1, 2)
    off = 0.01 * size * np.random.default_rng(SEED).normal(size=corners.shape)
    values = (corners + off).round().clip(0, (mask.shape[1], mask.shape[0])).astype(int)
    return f"method.polygon={values.tolist()}".replace(" ", "")


def measure(
    source: Source, clip: str, video: Path, folder: Path, method: str, *settings: str
) -> dict[str, object]:
    """Run the command; compare its masks with the true ones."""
    # Of the processor, so that other work on the machine does not count.
    began = _processor_seconds()
    toile("masks", f"video={video}", f"scene={folder}", f"method={method}", f"n_frames={len(source.frames)}",
          "overwrite=true", *settings)  # fmt: skip
    seconds = _processor_seconds() - began
    found = numbered_files(folder / "masks", "mask_")
    overlaps = []
    for k, file in found.items():
        a, b = read_mask(file).numpy() > 127, source.true_mask(k)
        overlaps.append((a & b).sum() / (a | b).sum())
    h, w = source.true_mask(0).shape
    marked = settings[0].partition("=")[0].removeprefix("method.") if method == "grabcut" else "–"
    return {
        "clip": f"{source.name} {clip}",
        "frames": f"{len(found)} of {w} x {h} px",
        "method": method,
        "marked by": marked,
        "IoU of frame 0": overlaps[0],
        "IoU, mean": np.mean(overlaps),
        "IoU, least": np.min(overlaps),
        "processor s per frame": seconds / len(found),
    }


def _processor_seconds() -> float:
    """What the commands called so far have taken."""
    times = os.times()
    return times.children_user + times.children_system


def sources(outputs: Path) -> list[Source]:
    """R1 where it is, and two generated scenes."""
    found = []
    r1 = data_folder() / "phi_sft" / "R1"
    if r1.is_dir():
        found.append(
            Source(
                "R1",
                sorted((r1 / "rgbs").glob("*.png")),
                sorted((r1 / "masks").glob("*.png")),
            )
        )
    else:
        print(f"R1 is not in {data_folder()}; set TOILE_DATA")
    for name, more in {
        "demo": (),
        "shaken": (
            "pinned_motion=shake",
            "settings.image_size=[540,960]",
            "settings.focal_length=780",
            "settings.seed=5",
        ),
    }.items():
        folder = outputs / f"generated_{name}"
        if not (folder / "scene.json").exists():
            toile("generate", "preset=demo", f"folder={folder}", *more)
        found.append(
            Source(name, sorted((folder / "rgbs").glob("*.png")), sorted((folder / "masks").glob("*.png")))
        )
    return found


def main() -> None:
    """See the module's text."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, help="of R1 before a wall; all by default")
    parser.add_argument("--outputs", type=Path, default=ROOT / "outputs" / "masks")
    options = parser.parse_args()
    outputs = options.outputs.resolve()
    outputs.mkdir(parents=True, exist_ok=True)
    marks: tuple[Callable[[np.ndarray], str], ...] = (box, polygon)
    rows = []
    for source in sources(outputs):
        first = source.true_mask(0)
        if source.name == "R1":
            published, folder = source.frames[0].parent, outputs / "R1_black"
            rows.append(measure(source, "on black", published, folder, "dark_background", f"fps={FPS}"))
            n = options.frames
            source = source._replace(frames=source.frames[:n], masks=source.masks[:n])  # noqa: PLW2901
        for kind in ("plain", "cluttered"):
            video = outputs / f"{source.name}_{kind}.mp4"
            film(source, wall(*first.shape, cluttered=kind == "cluttered"), video)
            for mark in marks:
                folder = outputs / f"{source.name}_{kind}_{mark.__name__}"
                rows.append(measure(source, f"before a {kind} wall", video, folder, "grabcut", mark(first)))
    where = machine()
    table = pd.DataFrame(rows).to_markdown(index=False, floatfmt=".3f")
    cores = f"{where['processor']}, {where['processors']} cores"
    command = "python benchmarks/masks.py" + (f" --frames {options.frames}" if options.frames else "")
    note = "seconds are of one processor, with start, decoding and writing"
    text = f"`{command}`, on {cores}; {note}.\n\n{table}\n"
    (ROOT / "docs" / "results" / "masks.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
