"""Finding scenes by name in the data folder, and loading them without naming their layout.

The data folder is the argument, else the environment variable TOILE_DATA, else ``./data``. It may hold

::

    phi_sft/scenes/R1.json ...        the φ-SfT layout
    independent/labelled/<id>/        native layout
    independent/withheld/<id>/
    <any other folder>/<name>/        native layout, e.g. generated scenes
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from toile.errors import InputError
from toile.limits import Count, CountOrZero, Finite, Fraction, Positive, Unit
from toile.scenes.native import load_native
from toile.scenes.phi_sft import load_phi_sft, load_phi_sft_template
from toile.scenes.scene import Scene
from toile.scenes.template import Template
from toile.scenes.texture_coordinates import Texturing, from_file

DATA_VARIABLE = "TOILE_DATA"
_DEEPEST = 3  # levels of folders below the data folder in which native scenes are looked for


@dataclass(frozen=True)
class SceneLocation:
    """Where a scene is.

    Attributes:
        name: scene name.
        folder: folder of a native scene, or root of the φ-SfT layout.
        native: whether the layout is the native one.
    """

    name: str
    folder: Path
    native: bool


def data_folder(explicit: Path | str | None = None) -> Path:
    """The data folder: ``explicit``, else TOILE_DATA, else ``./data``; it need not exist."""
    return Path(explicit if explicit is not None else os.environ.get(DATA_VARIABLE) or "data")


def available_scenes(data_dir: Path | str | None = None) -> dict[str, SceneLocation]:
    """All scenes in the data folder by name; φ-SfT names first. Scenes without a video are included."""
    root = data_folder(data_dir)
    found = {
        path.stem: SceneLocation(path.stem, root / "phi_sft", native=False)
        for path in sorted((root / "phi_sft" / "scenes").glob("*.json"))
    }
    for depth in range(1, _DEEPEST + 1):
        for path in sorted(root.glob("*/" * depth + "scene.json")):
            folder = path.parent
            found.setdefault(folder.name, SceneLocation(folder.name, folder, native=True))
    return found


def find_scene(name: str | Path, data_dir: Path | str | None = None) -> SceneLocation:
    """Location of a scene by its name in the data folder, or by the path of a native folder.

    Raises:
        InputError: neither; the message lists the scenes there are.
    """
    root = data_folder(data_dir)
    found = available_scenes(root)
    if str(name) in found:
        return found[str(name)]
    for folder in (Path(name), root / name):
        if folder.is_dir() and folder.resolve() != root.resolve():
            return SceneLocation(folder.resolve().name, folder, native=True)
    if not root.is_dir():
        got = f"no data folder {root}; set {DATA_VARIABLE} or pass data_dir"
    else:
        got = f"{root} holds {', '.join(found) or 'no scene'}"
    raise InputError(
        f"Scene {name} is not found",
        where=str(root),
        expected="the name of a scene in the data folder, or a folder with scene.json",
        got=got,
    )


def load_scene(
    name: str | Path,
    data_dir: Path | str | None = None,
    *,
    n_frames: Annotated[Count, Unit("frames")] | None = None,
    crop_margin: Annotated[CountOrZero, Unit("px")] | None = 24,
    minimum_component: Fraction = 0.1,
    texture_coordinates: Texturing = from_file,
    fps: Annotated[Positive, Unit("1/s")] | None = None,
    gravity: Sequence[Annotated[Finite, Unit("m/s²")]] | None = None,
    held_vertices: Sequence[CountOrZero] | None = None,
) -> Scene:
    """Load a scene by name ("R1", "a1cb40") or by the path of a native folder.

    Args:
        name: scene name or folder.
        data_dir: data folder; None for TOILE_DATA, else ``./data``.
        n_frames: load only the first ones; None for all.
        crop_margin: crop to the bounding box of all masks plus this margin [px]; None keeps whole images.
        minimum_component: drop mask components smaller than this fraction of the largest; 0 keeps all.
        texture_coordinates: from_file, projected, or another function of that signature.
        fps: frames per second; None for what the data (native) or the published fit (φ-SfT: 50) says.
        gravity: [m/s²]; None for what the data says (native) or (0, 9.81, 0).
        held_vertices: flattened grid indices; None for what the data says (native) or (0, 992).

    Raises:
        InputError: the scene is not found, has no video, or anything in it is wrong.
    """
    location = find_scene(name, data_dir)
    changes: dict[str, Any] = {"fps": fps, "gravity": gravity, "held_vertices": held_vertices}
    options: dict[str, Any] = {
        "n_frames": n_frames,
        "crop_margin": crop_margin,
        "minimum_component": minimum_component,
        "texture_coordinates": texture_coordinates,
        **{key: value for key, value in changes.items() if value is not None},
    }
    if location.native:
        return load_native(location.folder, **options)
    return load_phi_sft(location.name, location.folder, **options)


def load_template(name: str, data_dir: Path | str | None = None) -> Template:
    """Template, texture and camera of a φ-SfT scene ("R1" to "R9"), with or without a video.

    Raises:
        InputError: no φ-SfT scene of that name in the data folder, or anything in it is wrong.
    """
    location = find_scene(name, data_dir)
    if location.native:
        raise InputError(
            f"Scene {name} has no separate template",
            where=str(location.folder),
            expected="a scene of the φ-SfT layout; load_scene(...).template serves for the others",
            got="a scene in the native layout",
        )
    return load_phi_sft_template(location.name, location.folder)
