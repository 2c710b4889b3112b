"""The pictures of pages in the documentation, from demo runs: ``make screenshots``.

One function per picture, in ``PICTURES``; ``python docs/images/make_screenshots.py report`` makes one.
Needs a Chromium. Runs that are already there are used again.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import chdir, contextmanager
from pathlib import Path

import chromium
from PIL import Image
from tensorboard import program

ROOT = Path(__file__).resolve().parents[2]
HERE = Path(__file__).resolve().parent
RUNS = ROOT / "outputs" / "screenshots"
MAX_BYTES = 400_000
SEEDS = "0,1"
CHANGES = "optimization.stages.track.priors.turbulence=10,1"
"""What the runs of the sweep differ in."""
FLAG = (
    "preset=demo",
    "settings.name=flag",
    "settings.grid=[12,12]",
    "settings.n_frames=16",
    "settings.image_size=[96,96]",
    "settings.focal_length=140",
)
"""A scene that is fitted in seconds."""
ABLATIONS = (
    "experiment=paper",
    "ablation=none,no_turbulence",
    "simulator=implicit,surrogate",
    "optimization.cycles=80",
    "callbacks.chamfer.every=5",
    "report.video=false",
)
"""What the runs in the dashboard differ in."""


def toile(*arguments: str) -> None:
    """Run a command of toile in the repository."""
    subprocess.run([sys.executable, "-m", "toile.cli.main", *arguments], cwd=ROOT, check=True)


def demo_scene() -> str:
    """Data folder with the scene "demo"."""
    folder = RUNS / "data"
    if not (folder / "generated" / "demo" / "scene.json").is_file():
        toile("generate", "preset=demo", f"paths.data={folder}")
    return f"paths.data={folder}"


def demo_run() -> Path:
    """A fit of the demo."""
    folder, data = RUNS / "demo", demo_scene()
    if not (folder / "index.html").is_file():
        toile("fit", "experiment=demo", data, f"hydra.run.dir={folder}")
    toile("report", str(folder), data)
    return folder


def demo_sweep() -> Path:
    """Fits of the demo with several seeds and settings."""
    folder, data = RUNS / "sweep of the demo", demo_scene()
    if len(list(folder.glob("*/index.html"))) < 4:
        sweep = f"hydra.sweep.dir='{folder}'"
        toile("fit", "-m", "experiment=demo", data, f"seed={SEEDS}", CHANGES, sweep)
    toile("report", str(folder))
    return folder


def ablations() -> Path:
    """Fits of a small scene by the paper's recipe, which differ in ablation and simulator."""
    scene, folder = RUNS / "flag", RUNS / "ablations of the flag"
    if not (scene / "scene.json").is_file():
        toile("generate", f"folder={scene}", *FLAG)
    if len(list(folder.glob("*/metrics.json"))) < 4:
        toile("fit", "-m", f"scene={scene}", *ABLATIONS, f"hydra.sweep.dir='{folder}'")
    return folder


@contextmanager
def tensorboard(folder: Path) -> Iterator[str]:
    """TensorBoard on a free port, once it has read all runs; gives its address."""
    board = program.TensorBoard()
    # The page shows the folder as it is given here, and nobody's home belongs into a picture.
    with chdir(ROOT):
        where = str(folder.relative_to(ROOT))
        board.configure(argv=["", "--logdir", where, "--port", "0", "--load_fast", "false"])
        address = board.launch().rstrip("/")
        expected = len(list(folder.glob("*/tensorboard")))
        for _ in range(120):
            with urllib.request.urlopen(f"{address}/data/runs") as answer:
                if len(json.load(answer)) == expected:
                    break
            time.sleep(0.5)
        # A run is listed when its first events are read, not its last.
        time.sleep(10)
        yield address


def dashboard(picture: Path) -> None:
    """TensorBoard's charts of several runs."""
    with tensorboard(ablations()) as address:
        page = f"{address}/#custom_scalars&_smoothingWeight=0"
        chromium.show(page, picture, width=1500, height=1280)


def hparams(picture: Path) -> None:
    """TensorBoard's table of several runs."""
    with tensorboard(ablations()) as address:
        chromium.show(f"{address}/#hparams", picture, width=2200, height=480)


def report(picture: Path) -> None:
    """The page of a run, opened where the cloth has moved."""
    chromium.show((demo_run() / "index.html").as_uri() + "#frame=14", picture, width=1400, height=1400)


def sweep(picture: Path) -> None:
    """The page of several runs."""
    chromium.show((demo_sweep() / "report.html").as_uri(), picture, width=1400, height=1300)


PICTURES: dict[str, Callable[[Path], None]] = {
    "report": report,
    "sweep": sweep,
    "dashboard": dashboard,
    "hparams": hparams,
}
"""Functions that write a PNG, by the name of the picture."""


def compressed(picture: Path, target: Path) -> None:
    """Write a picture with a palette, as small as it has to be."""
    image = Image.open(picture).convert("RGB")
    for colours in (256, 128, 64, 32):
        image.quantize(colours, dither=Image.Dither.NONE).save(target, optimize=True)
        if target.stat().st_size < MAX_BYTES:
            return
    raise SystemExit(f"{target} has {target.stat().st_size} bytes, more than {MAX_BYTES}")


def main(names: list[str]) -> None:
    """Make the pictures with these names, or all."""
    for name in names or PICTURES:
        with tempfile.TemporaryDirectory() as folder:
            taken = Path(folder) / f"{name}.png"
            PICTURES[name](taken)
            compressed(taken, HERE / f"{name}.png")
        print(HERE / f"{name}.png")


if __name__ == "__main__":
    main(sys.argv[1:])
