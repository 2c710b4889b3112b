"""A scene consists of what lies in its folder, whatever its scene.json says."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from toile.errors import InputError
from toile.scenes.doctor import diagnose_folder
from toile.scenes.findings import Severity
from toile.scenes.native import load_native


def edit(folder: Path, **changes: Any) -> None:
    path = folder / "scene.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


@pytest.mark.parametrize(
    ("key", "name", "elsewhere"),
    [
        ("texture", "texture.png", "../texture.png"),
        ("template", "template.obj", "../template.obj"),
        ("rgb", "rgbs/rgb_%03d.png", "../rgbs/rgb_%03d.png"),
        ("mask", "masks/mask_%03d.png", "../masks/mask_%03d.png"),
    ],
)
@pytest.mark.parametrize("absolute", [False, True])
def test_files_outside_are_refused(
    tiny_folder: Path, key: str, name: str, elsewhere: str, absolute: bool
) -> None:
    """Also where everything else about them is right."""
    top = Path(name).parts[0]
    (tiny_folder / top).rename(tiny_folder.parent / top)
    edit(tiny_folder, files={key: str(tiny_folder.parent / name) if absolute else elsewhere})
    with pytest.raises(InputError, match="outside its folder") as refused:
        load_native(tiny_folder)
    assert str(tiny_folder.parent / top) in refused.value.got
    errors = [f for f in diagnose_folder(tiny_folder) if f.severity is Severity.ERROR]
    assert "outside its folder" in errors[0].what


@pytest.mark.parametrize("name", ["texture.png", "masks/mask_002.png", "rgbs"])
def test_links_that_lead_outside_are_refused(tiny_folder: Path, name: str) -> None:
    moved = tiny_folder.parent / "elsewhere"
    (tiny_folder / name).rename(moved)
    (tiny_folder / name).symlink_to(moved)
    with pytest.raises(InputError, match="outside its folder") as refused:
        load_native(tiny_folder)
    assert "elsewhere" in refused.value.got


def test_links_inside_and_a_linked_folder_are_fine(tiny_folder: Path) -> None:
    (tiny_folder / "texture.png").rename(tiny_folder / "cloth.png")
    (tiny_folder / "texture.png").symlink_to("cloth.png")
    edit(tiny_folder, files={"template": "rgbs/../template.obj"})
    link = tiny_folder.parent / "link"
    link.symlink_to(tiny_folder)
    assert load_native(link).n_frames == 4


@pytest.mark.parametrize(
    "pattern", ["rgbs/rgb.png", "rgbs/%03d_%03d.png", "rgbs/%s.png", "rgbs/%c", "%999999d"]
)
def test_patterns_without_one_number_are_refused(tiny_folder: Path, pattern: str) -> None:
    edit(tiny_folder, files={"rgb": pattern})
    with pytest.raises(InputError, match="'files' cannot be understood"):
        load_native(tiny_folder)


def test_billions_of_frames_are_not_looked_for(tiny_folder: Path) -> None:
    edit(tiny_folder, n_frames=10**12)
    with pytest.raises(InputError, match=r"rgb_004\.png is missing"):
        load_native(tiny_folder)


def test_numbers_beyond_all_bounds(tiny_folder: Path) -> None:
    edit(tiny_folder, fps=10**400)
    with pytest.raises(InputError, match="'fps' cannot be understood"):
        load_native(tiny_folder)
