"""The wheel, installed into an environment without the repository, does what the README shows."""

from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[2]
TINY = (
    "settings.grid=[8,8]",
    "settings.refinement=1",
    "settings.n_frames=4",
    "settings.substeps=2",
    "settings.image_size=[64,64]",
    "settings.focal_length=96",
    "texture.height=64",
    "texture.width=64",
)


def run(*command: object, **options: object) -> str:
    done = subprocess.run([str(c) for c in command], capture_output=True, text=True, check=False, **options)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    # A build leaves its products in the tree it is started in.
    source = folder / "source"
    source.mkdir()
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE", "src", "conf"):
        (source / name).symlink_to(REPOSITORY / name)
    run(sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "-w", folder, source)
    (found,) = folder.glob("*.whl")
    return found


def test_every_file_is_in_the_wheel(wheel: Path) -> None:
    inside = set(zipfile.ZipFile(wheel).namelist())
    source = REPOSITORY / "src"
    kinds = ("*.py", "*.typed", "*.pt", "*.css", "*.js", "*.csv", "*.json", "*.npz")
    modules = {p.relative_to(source).as_posix() for kind in kinds for p in (source / "toile").rglob(kind)}
    settings = {
        f"toile/{p.relative_to(REPOSITORY).as_posix()}" for p in (REPOSITORY / "conf").rglob("*.yaml")
    }
    assert modules - inside == set()
    assert settings - inside == set()
    assert not [name for name in inside if name.startswith(("conf/", "src/", "tests/"))]


def test_the_demo_runs_from_the_wheel_in_another_folder(wheel: Path, tmp_path: Path) -> None:
    """Generate and fit; only the dependencies are shared with the environment of the tests."""
    environment, work = tmp_path / "environment", tmp_path / "elsewhere"
    venv.create(environment, with_pip=False)
    work.mkdir()
    folder = Path(sysconfig.get_path("purelib", vars={"base": str(environment)}))
    # Plain paths in a .pth file: the editable install of the repository is not among them.
    (folder / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n", encoding="utf-8")
    python = Path(sysconfig.get_path("scripts", vars={"base": str(environment)})) / "python"
    run(sys.executable, "-m", "pip", "--python", python, "install", "--no-deps", "--no-index", wheel)
    outside = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "TOILE_DATA")}
    options = {"cwd": work, "env": outside}
    where = run(python, "-c", "import toile; print(toile.__file__)", **options)
    assert Path(where.strip()).is_relative_to(environment)
    toile = python.with_name("toile")
    run(toile, "generate", "preset=demo", *TINY, **options)
    run(toile, "fit", "experiment=demo", "report.video=false", "hydra.run.dir=run", **options)
    for name in ("trajectory.npz", "metrics.json", "index.html"):
        assert (work / "run" / name).is_file()
