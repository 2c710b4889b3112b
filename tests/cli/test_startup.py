"""What a command loads before it has anything to compute: a subprocess tells what it has imported."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from toile import __version__
from toile.cli.commands import COMMANDS

HEAVY = (
    "torch",
    "lightning",
    "kornia",
    "warp",
    "trimesh",
    "igl",
    "numpy",
    "pandas",
    "matplotlib",
    "plotly",
    "jinja2",
    "scipy",
    "sklearn",
    "arch",
    "cv2",
    "imageio",
    "tensorboard",
    "pxr",
)
_CODE = """
import sys
from toile.cli.main import main
status = main(sys.argv[2:])
loaded = sorted(set(sys.argv[1].split(",")) & {name.partition(".")[0] for name in sys.modules})
print("\\nloaded:", *loaded, file=sys.stderr)
sys.exit(status)
"""


def loaded(*arguments: str, status: int = 0) -> tuple[list[str], str]:
    """The heavy libraries that a call has imported, and what it has printed."""
    command = [sys.executable, "-c", _CODE, ",".join(HEAVY), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == status, done.stderr
    return done.stderr.rpartition("loaded:")[2].split(), done.stdout + done.stderr


@pytest.mark.parametrize(
    "arguments",
    [
        ("--help",),
        ("--version",),
        ("fit", "--version"),
        *((command, "--help") for command in COMMANDS),
        ("fit", "scene=R1", "--cfg", "job"),
        ("diagnose", "scene=R1", "--cfg", "all"),
        ("train", "--cfg", "hydra"),
        ("fit", "--info", "searchpath"),
        ("completion", "bash"),
        ("completion", "words", "fit", "optimization="),
    ],
    ids=" ".join,
)
def test_looking_around_loads_nothing_heavy(arguments: tuple[str, ...]) -> None:
    assert loaded(*arguments)[0] == []


@pytest.mark.parametrize(
    "arguments", [("fti",), ("fit", "scnee=R1"), ("fit", "optimization=traking"), ("report", "n=[")]
)
def test_neither_do_mistakes_in_typing(arguments: tuple[str, ...]) -> None:
    assert loaded(*arguments, status=2)[0] == []


def test_doctor_loads_what_reads_a_scene(scene_folder: Path) -> None:
    found, said = loaded("doctor", f"scene={scene_folder}")
    assert "errors: 0" in said
    assert "torch" in found
    # cv2 tells whether the camera moves.
    assert set(found) <= {"torch", "numpy", "scipy", "cv2"}


@pytest.mark.parametrize(
    "arguments", [("--version",), ("fit", "--version"), ("fit", "scene=R1", "--version")]
)
def test_version_is_that_of_toile(toile, arguments) -> None:
    assert toile(*arguments) == (0, f"toile {__version__}\n", "")


@pytest.mark.parametrize(
    "arguments",
    [
        ("--help",),
        ("fit", "--help"),
        ("fit", "--cfg", "job"),
        ("doctor", "scene={scene}"),
        ("completion", "bash"),
    ],
    ids=" ".join,
)
def test_a_reader_that_has_gone(arguments, scene_folder: Path) -> None:
    """As ``| head -1`` leaves it, but certainly before anything is printed."""
    reading, writing = os.pipe()
    os.close(reading)
    command = [sys.executable, "-m", "toile.cli.main", *(a.format(scene=scene_folder) for a in arguments)]
    try:
        done = subprocess.run(command, stdout=writing, stderr=subprocess.PIPE, text=True, check=False)
    finally:
        os.close(writing)
    assert (done.returncode, done.stderr) == (0, "")
