"""The truth of a generated scene: a file beside the ground truth that fits never read."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from toile.errors import InputError
from toile.generation.refinement import refined_material, refined_size
from toile.generation.settings import GeneratorSettings
from toile.generation.starting_point import StartingPoint
from toile.json_file import read_json_object
from toile.physics.material import Material
from toile.scenes.atomic_folder import folder_written_atomically
from toile.scenes.native import write_native
from toile.scenes.scene import Scene
from toile.scenes.template import Template

TRUTH_FILE = "ground_truth/truth.json"
TRUTH_FORMAT = 1


def describe(
    settings: GeneratorSettings, start: StartingPoint, template: Template | None = None
) -> dict[str, Any]:
    """True parameters as JSON values.

    Keys, with Y, S and B each as ``stretching``, ``shearing`` and ``bending``:

    - ``network_units``: Y, S, B on the fit's grid with one step per frame
    - ``si``: the same in N/m, N·m, N·m; ``si_simulated_grid``: on the grid that was simulated
    - ``wind``, ``initial_wind``, ``gravity``: [m/s²]; ``areal_density`` [kg/m²]; ``cloth_size`` [m]
    - ``grid``, ``simulated_grid``, ``substeps``, ``integrator``, ``fps``, ``n_frames``
    - ``pinned_vertices``, ``pinned_motion`` (its kind and numbers), ``template`` (name or null)
    - ``settings``: all settings of the generator
    """
    material = settings.material(start.cloth_size)
    motion = {"kind": type(settings.pinned_motion).__name__, **asdict(settings)["pinned_motion"]}
    truth = {
        "format": TRUTH_FORMAT,
        "network_units": {
            "stretching": settings.stretching,
            "shearing": settings.shearing,
            "bending": settings.bending,
        },
        "si": _si(material),
        "si_simulated_grid": _si(refined_material(material, settings.refinement)),
        "wind": settings.wind,
        "initial_wind": settings.initial_wind,
        "gravity": settings.gravity,
        "areal_density": settings.areal_density,
        "cloth_size": start.cloth_size,
        "grid": settings.grid,
        "simulated_grid": refined_size(settings.grid, settings.refinement),
        "substeps": settings.substeps,
        "integrator": "BDF2",
        "fps": settings.fps,
        "n_frames": settings.n_frames,
        "pinned_vertices": start.pinned,
        "pinned_motion": motion,
        "template": None if template is None else template.name,
        "settings": {**asdict(settings), "pinned_motion": motion},
    }
    values: dict[str, Any] = json.loads(json.dumps(truth))
    return values


def write(scene: Scene, truth: dict[str, Any], folder: Path | str, *, overwrite: bool = False) -> Path:
    """Write a generated scene in the native layout plus TRUTH_FILE; the folder appears only when complete.

    Raises:
        InputError: the folder exists and ``overwrite`` is False.
    """
    folder = Path(folder)
    with folder_written_atomically(folder, overwrite=overwrite) as new:
        write_native(scene, new)
        path = new / TRUTH_FILE
        path.parent.mkdir(exist_ok=True)
        path.write_text(json.dumps(truth, indent=1) + "\n")
    return folder


def read_truth(folder: Path | str) -> dict[str, Any]:
    """True parameters of a generated scene; for evaluation only.

    Raises:
        InputError: the folder has none.
    """
    path = Path(folder) / TRUTH_FILE
    try:
        return read_json_object(path)
    except (OSError, ValueError) as error:
        raise InputError(
            "True parameters cannot be read",
            where=str(path),
            expected="the truth.json of a generated scene",
            got=f"{type(error).__name__}: {error}",
        ) from error


def _si(material: Material) -> dict[str, float]:
    """Stiffnesses of a material of one scene."""
    return material.parameters.unpack(material.values[0].tolist())
