"""The page of a clip: what it shows is what was measured, with nothing from a network."""

from __future__ import annotations

import base64
import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from toile.capture.data.clips import TRUTH_FILE, Truth
from toile.capture.data.filming import CameraRing, LandmarkNoise, Looks, film
from toile.errors import InputError
from toile.rendering.warp.renderer import WarpRenderer
from toile.reports.page.capture_page import shown_body, write_capture_page
from toile.scenes.native import write_multi_view_description
from toile.scenes.native_views import view_files

BALL = trimesh.creation.icosphere(subdivisions=2, radius=0.3)
RING = CameraRing(views=2, side=40, distance=2.0, height=0.5, target=0.5, field_of_view=40.0)


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    """A ball that sinks 2 cm a frame into a sheet that begins on top of it."""
    body = np.asarray(BALL.vertices) + np.array([0, 0.5, 0])
    sheet = trimesh.creation.box((0.5, 0.001, 0.5)).subdivide().subdivide()
    cloth = np.asarray(sheet.vertices) + np.array([0, 0.8006, 0])
    frames = np.stack([cloth - np.array([0, 0.02 * f, 0]) for f in range(3)])
    truth = Truth(
        np.repeat(body[None], 3, 0),
        np.asarray(BALL.faces, dtype=np.int64),
        frames,
        np.asarray(sheet.faces, dtype=np.int64),
        25.0,
    )
    folder = tmp_path / "000-sink"
    rng = np.random.default_rng(0)
    looks = Looks.random(rng, 16)
    recording = film(truth, RING.cameras(), looks, LandmarkNoise(), rng, WarpRenderer(), folder, folder.name)
    files = [view_files(view, f"views/{view.name}") for view in recording.views]
    write_multi_view_description(recording, folder, files)
    truth.save(folder / TRUTH_FILE, recording)
    return folder


def data_of(page: str) -> dict:
    found = re.search(r'id="viewer-data">(.*?)</script>', page, re.DOTALL)
    assert found is not None
    return json.loads(found[1])


def test_the_page_holds_motion_pictures_and_penetration_of_every_frame(clip: Path) -> None:
    page = write_capture_page(clip).read_text()
    assert 'src="http' not in page
    data = data_of(page)
    assert data["frames"] == [0, 1, 2]
    assert {name: len(pictures) for name, pictures in data["pictures"].items()} == {
        "camera camera0": 3,
        "novel view": 3,
    }
    (depth,) = (m for m in data["maps"] if m["key"] == "depth")
    values = np.frombuffer(base64.b64decode(depth["values"]), "<f4").reshape(3, -1)
    assert values[0].max() < 1
    assert values[2].max() == pytest.approx(40, abs=2)
    body, garment = data["meshes"]
    positions = np.frombuffer(base64.b64decode(garment["positions"]), "<f4").reshape(3, -1, 3)
    truth = Truth.load(clip / TRUTH_FILE)
    assert positions == pytest.approx(truth.garment_positions, abs=1e-6)
    assert body["vertices"] == len(BALL.vertices)
    assert re.search(r"4\d\.\d<small> mm</small></span>largest penetration", page) or "39." in page


def test_frames_may_be_left_out_and_a_missing_camera_is_named(clip: Path) -> None:
    assert data_of(write_capture_page(clip, view=1, every=2).read_text())["frames"] == [0, 2]
    with pytest.raises(InputError, match="No such view"):
        write_capture_page(clip, view=2)


def test_a_large_body_is_shown_with_fewer_faces_of_its_own_vertices() -> None:
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.3)
    x = np.asarray(ball.vertices)[None] * np.array([1.0, 2.0])[:, None, None]
    small = np.zeros((2, 3, 3))
    truth = Truth(x, np.asarray(ball.faces, dtype=np.int64), small, np.array([[0, 1, 2]]), 25.0)
    shown, faces = shown_body(truth)
    assert 2500 < len(faces) <= 3000
    assert shown[1] == pytest.approx(2 * shown[0])
    assert np.linalg.norm(shown[0], axis=1) == pytest.approx(np.full(shown.shape[1], 0.3))
    area = trimesh.Trimesh(shown[0], faces, process=False).area
    assert area == pytest.approx(ball.area, rel=0.02)
    assert torch.from_numpy(faces).max() < shown.shape[1]
