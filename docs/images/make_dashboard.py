"""Makes the pictures of the dashboard, dashboard.png and hparams.png: a small sweep, TensorBoard, Chromium.

    python docs/images/make_dashboard.py

The sweep in outputs/dashboard takes some minutes the first time; afterwards only the pictures are taken.
"""

from __future__ import annotations

import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from chromium import show
from tensorboard import program

ROOT = Path(__file__).resolve().parents[2]
IMAGES = Path(__file__).resolve().parent
SWEEP = ROOT / "outputs" / "dashboard"
SCENE = (
    "preset=demo",
    "settings.name=flag",
    "settings.grid=[12,12]",
    "settings.n_frames=16",
    "settings.image_size=[96,96]",
    "settings.focal_length=140",
)
FITS = (
    "experiment=paper",
    "ablation=none,no_turbulence",
    "simulator=implicit,surrogate",
    "optimization.cycles=80",
    "callbacks.chamfer.every=5",
    "report.video=false",
)
# Page of TensorBoard, picture, and its size in pixels.
PICTURES = {
    "custom_scalars&_smoothingWeight=0": ("dashboard.png", (1500, 1280)),
    "hparams": ("hparams.png", (1900, 560)),
}


def make_sweep() -> None:
    """Four fits that differ in ablation and simulator; nothing where they exist."""
    scene = SWEEP / "flag"
    if not (scene / "scene.json").exists():
        toile("generate", f"folder={scene}", *SCENE)
    if len(list(SWEEP.glob("fits/*/metrics.json"))) < 4:
        toile("fit", "-m", f"scene={scene}", *FITS, f"hydra.sweep.dir={SWEEP / 'fits'}")


def toile(*arguments: str) -> None:
    """Run one command."""
    subprocess.run([str(Path(sys.executable).parent / "toile"), *arguments], cwd=ROOT, check=True)


@contextmanager
def tensorboard(folder: Path, n_runs: int) -> Iterator[str]:
    """TensorBoard on a free port, once it has found all runs; gives its address."""
    board = program.TensorBoard()
    board.configure(argv=["", "--logdir", str(folder), "--port", "0", "--load_fast", "false"])
    address = board.launch().rstrip("/")
    for _ in range(120):
        with urllib.request.urlopen(f"{address}/data/runs") as answer:
            if answer.read().count(b'"') == 2 * n_runs:
                break
        time.sleep(0.5)
    yield address


def main() -> None:
    """See the module's text."""
    make_sweep()
    with tensorboard(SWEEP / "fits", n_runs=4) as address:
        for page, (name, size) in PICTURES.items():
            show(f"{address}/#{page}", IMAGES / name, width=size[0], height=size[1])
            print(IMAGES / name)


if __name__ == "__main__":
    main()
