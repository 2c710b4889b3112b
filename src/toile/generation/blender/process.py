"""Blender as a process of its own."""

from __future__ import annotations

import functools
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from toile.errors import InputError
from toile.generation.blender.engine import DONE
from toile.physics.simulator import SimulationError

ENVIRONMENT = "TOILE_BLENDER_PYTHON"
"""Environment variable with the interpreter that has bpy."""
_SOURCES = Path(__file__).parents[3]
# Appended, so that the interpreter's own NumPy and bpy come first.
_START = "import sys; sys.path.append(sys.argv.pop(1)); from {0} import main; main(*sys.argv[1:])"
ENGINE = "toile.generation.blender.engine"
"""Sheets of cloth."""
PERSON_ENGINE = "toile.generation.blender.person"
"""A garment on a moving body."""


class BlenderError(SimulationError):
    """Blender stopped before it was done."""


def interpreter(python: str | None = None) -> str:
    """The interpreter that Blender runs in: the given one, that of ENVIRONMENT, or the running one.

    Raises:
        InputError: bpy cannot be imported there.
    """
    python = _chosen(python)
    problem = _problem(python)
    if problem:
        raise InputError(
            "Blender's Python module bpy cannot be imported",
            where=python,
            expected="bpy 4.2: pip install 'toile[blender]', or name an interpreter that has it by "
            f"{ENVIRONMENT} or settings.python (bpy 4.2 needs Python 3.11; on a bare Linux also apt-get "
            "install libxi6 libxxf86vm1 libxfixes3 libxrender1 libgl1 libsm6 libxkbcommon0)",
            got=problem,
        )
    return python


def available(python: str | None = None) -> bool:
    """Whether bpy can be imported by the interpreter that ``interpreter`` would choose."""
    return not _problem(_chosen(python))


def _chosen(python: str | None) -> str:
    return python or os.environ.get(ENVIRONMENT) or sys.executable


@functools.cache
def _problem(python: str) -> str:
    """What goes wrong when bpy is imported; empty if nothing."""
    try:
        result = subprocess.run(
            [python, "-c", "import bpy; print('imported')"], capture_output=True, text=True, check=False
        )
    except OSError as error:
        return str(error)
    if "imported" in result.stdout:
        return ""
    return result.stderr.strip().rpartition("\n")[2] or f"exit status {result.returncode}"


def run(request: dict[str, Any], folder: Path, python: str | None = None, engine: str = ENGINE) -> None:
    """Let the engine carry out a request and write its files to a folder.

    Args:
        request: see the engine.
        folder: for the request and the results; it need not exist.
        python: see interpreter.
        engine: module with ``main(request file, folder)`` that runs inside Blender.

    Raises:
        InputError: bpy cannot be imported.
        BlenderError: Blender stopped before it was done.
    """
    command = [interpreter(python), "-c", _START.format(engine), str(_SOURCES)]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / DONE).unlink(missing_ok=True)
    path = folder / "request.json"
    path.write_text(json.dumps(request))
    threads = str(request["threads"])
    limits = {name: threads for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}
    result = subprocess.run(
        [*command, str(path), str(folder)],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, **limits},
    )
    if not (folder / DONE).exists():
        raise BlenderError(
            f"Blender stopped with status {result.returncode}:\n{(result.stderr or result.stdout)[-2000:]}"
        )
