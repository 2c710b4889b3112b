"""A video with masks and landmarks becomes a recording, and what does not fit is named."""

from __future__ import annotations

import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from toile.capture.test_time.own_clip import OwnCamera, write_own_clip
from toile.capture.training.frames import camera_frames
from toile.errors import InputError
from toile.preparation.video import open_clip
from toile.scenes.multi_view import load_multi_view


@pytest.fixture
def material(tiny_clip: Any, tmp_path: Path) -> Path:
    """Frames, masks and landmarks of the first camera of the tiny clip, as a user would have them."""
    views = tiny_clip.folder / "views" / "camera0"
    for name, stem in (("frames", "rgb"), ("masks/person", "mask"), ("masks/garment", "garment_mask")):
        place = tmp_path / name
        place.mkdir(parents=True)
        for file in sorted(views.glob(f"{stem}_*.png")):
            shutil.copy(file, place / file.name)
    shutil.copy(views / "landmarks.npy", tmp_path / "landmarks.npy")
    return tmp_path


def written(material: Path, tiny_clip: Any, camera: OwnCamera | None = None) -> Path:
    return write_own_clip(
        open_clip(material / "frames", fps=30),
        material / "masks",
        material / "landmarks.npy",
        camera or OwnCamera(),
        tiny_clip.subject.landmark_names,
        material / "recording",
    )


def test_networks_see_the_same_as_in_the_data_set(material: Path, tiny_clip: Any) -> None:
    folder = written(material, tiny_clip, OwnCamera(field_of_view=40.0, height=1.1))
    names = tiny_clip.subject.landmark_names
    found = camera_frames(load_multi_view(folder), 0, names, 64)
    expected = camera_frames(load_multi_view(tiny_clip.folder), 0, names, 64)
    torch.testing.assert_close(found.images, expected.images)
    torch.testing.assert_close(found.detections, expected.detections)
    assert found.fps == 30
    assert found.camera.fx == pytest.approx(expected.camera.fx)


def test_camera_is_level_and_looks_down_by_its_pitch() -> None:
    level = OwnCamera(field_of_view=60.0, height=1.5).camera(640, 480)
    ahead = torch.tensor([0.0, 1.5, -3.0], dtype=torch.float64)
    torch.testing.assert_close(level.project(ahead), torch.tensor([320.0, 240.0], dtype=torch.float64))
    assert level.fx == pytest.approx(320 / math.tan(math.radians(30)))
    down = OwnCamera(height=1.5, pitch=30.0).camera(640, 480)
    floor = torch.tensor([0.0, 0.0, -1.5 / math.tan(math.radians(30))], dtype=torch.float64)
    torch.testing.assert_close(down.project(floor), torch.tensor([320.0, 240.0], dtype=torch.float64))
    # What is higher is farther up in the image.
    assert float(down.project(floor + torch.tensor([0.0, 0.1, 0.0]))[1]) < 240


def test_missing_and_surplus_masks_are_named(material: Path, tiny_clip: Any) -> None:
    last = sorted((material / "masks/garment").glob("*.png"))[-1]
    last.unlink()
    with pytest.raises(InputError, match="masks/garment"):
        written(material, tiny_clip)
    assert not (material / "recording").exists()
    shutil.rmtree(material / "masks/garment")
    with pytest.raises(InputError, match="Masks are missing"):
        written(material, tiny_clip)


def test_landmarks_of_another_skeleton_or_another_number_are_refused(material: Path, tiny_clip: Any) -> None:
    marks = np.load(material / "landmarks.npy")
    np.save(material / "landmarks.npy", marks[:, :5])
    with pytest.raises(InputError, match="do not fit the subject"):
        written(material, tiny_clip)
    np.save(material / "landmarks.npy", marks[:-1])
    with pytest.raises(InputError, match="one for each frame"):
        written(material, tiny_clip)
