"""Loading scenes by name or folder without naming their layout; ``locations`` says where they are."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from toile.errors import InputError
from toile.limits import Count, CountOrZero, Finite, Fraction, Positive, Unit
from toile.scenes.locations import DATA_VARIABLE, SceneLocation, available_scenes, data_folder, find_scene
from toile.scenes.native import load_native
from toile.scenes.phi_sft import load_phi_sft, load_phi_sft_template
from toile.scenes.scene import Scene, require_one_camera
from toile.scenes.template import Template
from toile.scenes.texture_coordinates import Texturing, from_file

__all__ = [
    "DATA_VARIABLE",
    "SceneLocation",
    "available_scenes",
    "data_folder",
    "find_scene",
    "load_scene",
    "load_template",
]


def load_scene(
    name: str | Path,
    data_dir: Path | str | None = None,
    *,
    n_frames: Annotated[Count, Unit("frames")] | None = None,
    crop_margin: Annotated[CountOrZero, Unit("px")] | None = 24,
    minimum_component: Fraction = 0.1,
    texture_coordinates: Texturing = from_file,
    fps: Annotated[Positive, Unit("1/s")] | None = None,
    gravity: Annotated[Sequence[Finite], Field(min_length=3, max_length=3), Unit("m/s²")] | None = None,
    pinned_vertices: Sequence[CountOrZero] | None = None,
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
        pinned_vertices: flattened grid indices; None for what the data says (native) or (0, 992).

    Raises:
        InputError: the scene is not found, has no video or several cameras, or anything in it is wrong.
    """
    location = find_scene(name, data_dir)
    changes: dict[str, Any] = {"fps": fps, "gravity": gravity, "pinned_vertices": pinned_vertices}
    options: dict[str, Any] = {
        "n_frames": n_frames,
        "crop_margin": crop_margin,
        "minimum_component": minimum_component,
        "texture_coordinates": texture_coordinates,
        **{key: value for key, value in changes.items() if value is not None},
    }
    if location.native:
        return require_one_camera(load_native(location.folder, **options))
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
