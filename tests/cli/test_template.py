"""``toile template``: from a video's folder to a scene that doctor accepts, three ways."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from toile.geometry.io import write_mesh, write_point_cloud
from toile.scenes.native import load_native

CAMERA = ("camera.fx=420", "camera.fy=410", "camera.cx=163", "camera.cy=117.5")
GRID = "grid=[12,10]"
WRITTEN = ("template.obj", "texture.png", "scene.json", "template.png")


@pytest.fixture
def video(curved_sheet, tmp_path: Path) -> Path:
    """A folder as ``toile masks`` leaves it, and two scans beside it."""
    vertices, faces = curved_sheet.irregular_mesh(600)
    write_mesh(tmp_path / "scan.ply", torch.from_numpy(vertices), faces)
    write_point_cloud(tmp_path / "cloud.npy", torch.from_numpy(curved_sheet.noisy_points()))
    return curved_sheet.write_video(tmp_path / "video", 6)


@pytest.mark.parametrize(
    "surface",
    [
        ("surface=mesh", "surface.file=scan.ply"),
        ("surface=points", "surface.file=cloud.npy"),
        ("surface=sheet", "cloth_size=[0.46,0.4]"),
    ],
)
def test_three_ways(toile, video, surface) -> None:
    status, out, err = toile("template", "scene=video", *surface, *CAMERA, GRID)
    assert (status, err) == (0, "")
    for name in WRITTEN:
        assert f"video/{name}" in out
        assert (video / name).is_file()
    assert "IoU" in out
    assert not list(video.glob(".*"))
    status, out, _ = toile("doctor", "scene=video")
    assert status == 0
    assert "errors: 0, warnings: 0" in out
    scene = load_native(video)
    assert scene.grid == (12, 10)
    assert scene.pinned_vertices == (0, 110)


def test_settings_reach_the_scene(toile, video) -> None:
    (video / "video.json").unlink()
    camera = {"focal_length": [420, 410], "optical_center": [163, 117.5]}
    Path("camera.json").write_text(json.dumps(camera))
    settings = ("fps=25", "pinned_vertices=[0]", "gravity=[0,9.7,1.4]", "cloth_size=[0.51,0.4]")
    status, _, err = toile(
        "template", "scene=video", "surface.file=scan.ply", "camera.file=camera.json", GRID, *settings
    )
    assert (status, err) == (0, "")
    scene = load_native(video)
    assert (scene.fps, scene.pinned_vertices, scene.cloth_size) == (25, (0,), (0.51, 0.4))
    assert scene.gravity.tolist() == [0, 9.7, 1.4]


def test_never_overwrites_unasked(toile, video) -> None:
    call = ("template", "scene=video", "surface.file=scan.ply", *CAMERA, GRID)
    (video / "template.obj").write_text("made by hand")
    status, _, err = toile(*call)
    assert status == 2
    assert "has a template already" in err
    assert (video / "template.obj").read_text() == "made by hand"
    assert not (video / "scene.json").exists()
    assert toile(*call, "overwrite=true").status == 0


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("surface.file=none.ply", *CAMERA), "none.ply is missing"),
        (("surface.file=scan.ply",), "intrinsics are missing"),
        (("surface.file=scan.ply", "axes=opengl", *CAMERA), "does not project onto the mask"),
        (("surface.file=scan.ply", "cloth_size=[5,5]", *CAMERA), "millimetres"),
        (("surface.file=scan.ply", "corners=[[1,2],[3]]", *CAMERA), "Corners cannot be understood"),
        (("surface.file=scan.ply", "fps=0", *CAMERA), "fps is not what it may be"),
        (("surface.file=scan.ply", "pinned_vertices=[4096]", *CAMERA), "out of range"),
        (("surface.file=scan.ply", "grid=[1,4]", *CAMERA), "grid is not what it may be"),
        (("surface=sheet", *CAMERA), "one camera cannot see it"),
        (("surface=points", "surface.file=scan.ply", "minimum_iou=1", *CAMERA), "minimum_iou"),
    ],
)
def test_bad_input_leaves_nothing_behind(toile, video, arguments, said) -> None:
    before = sorted(video.rglob("*"))
    status, _, err = toile("template", "scene=video", *arguments)
    assert status == 2
    assert said in err
    assert sorted(video.rglob("*")) == before


def test_missing_folder_and_published_scene(toile) -> None:
    status, _, err = toile("template", "scene=nowhere", "surface.file=scan.ply", *CAMERA)
    assert status == 2
    assert "nowhere is not found" in err
