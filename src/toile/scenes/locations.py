"""Where scenes are: their names in the data folder, found without loading what reads them.

The data folder is the argument, else the environment variable TOILE_DATA, else ``./data``. It may hold

::

    phi_sft/scenes/R1.json ...        the φ-SfT layout
    independent/labelled/<id>/        native layout
    independent/withheld/<id>/
    <any other folder>/<name>/        native layout, e.g. generated scenes
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from toile.errors import InputError

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
