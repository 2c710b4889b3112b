"""``toile doctor``: findings, exit status, sweeps."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from toile.scenes.native import write_native
from toile.scenes.scene import Scene


def change(scene_folder: Path, key: str, value: object) -> None:
    path = scene_folder / "scene.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {key: value}))


def test_sound_scene(toile, scene_folder: Path) -> None:
    before = sorted(Path().rglob("*"))
    status, out, err = toile("doctor", "scene=tiny")
    assert (status, err) == (0, "")
    assert "errors: 0" in out
    assert sorted(Path().rglob("*")) == before


def test_scene_by_folder_and_by_data_folder(toile, scene_folder: Path, monkeypatch, tmp_path) -> None:
    assert toile("doctor", f"scene={scene_folder}").status == 0
    scene_folder.parent.rename(tmp_path / "made")
    assert toile("doctor", "scene=tiny").status == 2
    assert toile("doctor", "scene=tiny", f"paths.data={tmp_path}").status == 0
    monkeypatch.setenv("TOILE_DATA", str(tmp_path))
    assert toile("doctor", "scene=tiny").status == 0


def test_unknown_scene_lists_what_is_there(toile, scene_folder: Path) -> None:
    status, out, _ = toile("doctor", "scene=tny")
    assert status == 2
    assert "tny is not found" in out
    assert "data holds tiny" in out


def test_missing_folder(toile) -> None:
    status, out, _ = toile("doctor", "scene=no/such/folder")
    assert status == 2
    assert "no/such/folder is not found" in out


@pytest.mark.parametrize(
    ("key", "value", "named"),
    [
        ("K", [[-110.0, 0.0, 62.5], [0.0, 105.0, 38.25], [0.0, 0.0, 1.0]], "-110"),
        ("fps", 0, "fps"),
        ("grid", [6, 6], "30"),
    ],
)
def test_wrong_values(toile, scene_folder: Path, key, value, named) -> None:
    change(scene_folder, key, value)
    status, out, _ = toile("doctor", "scene=tiny")
    assert status == 2
    assert "errors: 0" not in out
    assert named in out


def test_what_a_fit_cannot_do_is_an_error(toile, tiny_scene: Scene, tmp_path: Path) -> None:
    """Each of them is loaded without a word by commands that need no fit."""
    H, W = tiny_scene.grid
    folded = tiny_scene.template.clone()
    folded[2, 2] = folded[2, 3]
    white = torch.ones_like(tiny_scene.masks)
    near, far = (replace(tiny_scene.camera, fx=110.0 * zoom, fy=105.0 * zoom) for zoom in (2, 10))
    right = (white.cumsum(2) > 20).to(white.dtype)
    wrong = {
        "All vertices are pinned": replace(tiny_scene, pinned_vertices=tuple(range(H * W))),
        "frame rate": replace(tiny_scene, fps=1e9),
        "far too strong": replace(tiny_scene, gravity=1000 * tiny_scene.gravity),
        "coincide": replace(tiny_scene, template=folded, ground_truth=None),
        "white all over": replace(tiny_scene, masks=white, camera=near),
        "vertices inside mask 0": replace(tiny_scene, masks=right, camera=far),
    }
    for words, scene in wrong.items():
        write_native(scene, tmp_path / "data" / "made" / "wrong", overwrite=True)
        status, out, _ = toile("doctor", "scene=wrong")
        assert status == 2, words
        assert words in " ".join(out.replace("│", " ").split()), words


def test_one_frame_is_too_few(toile, scene_folder: Path) -> None:
    change(scene_folder, "n_frames", 1)
    status, out, _ = toile("doctor", "scene=tiny")
    assert status == 2
    assert "Too few frames" in " ".join(out.replace("│", " ").split())


def test_all_errors_at_once(toile, scene_folder: Path) -> None:
    (scene_folder / "rgbs" / "rgb_001.png").write_bytes(b"no image")
    (scene_folder / "masks" / "mask_002.png").unlink()
    status, out, _ = toile("doctor", "scene=tiny")
    assert status == 2
    assert "rgb_001.png" in out
    assert "mask_002.png" in out


def test_sweep_goes_on_after_a_bad_scene(toile, scene_folder: Path) -> None:
    status, out, _ = toile("doctor", "-m", "scene=nothing,tiny")
    assert status == 2
    assert "Scene nothing" in out
    assert "Scene tiny" in out
    assert "errors: 0" in out


def test_settings_that_it_does_not_look_at_are_refused(toile, scene_folder: Path) -> None:
    status, _, err = toile("doctor", "scene=tiny", "scene.fps=5000", "scene.pinned_vertices=[99999]")
    assert status == 2
    assert "scene.fps=5000" in err
    assert "scene.pinned_vertices" in err
    assert toile("doctor", f"scene.name={scene_folder}").status == 0
