"""Reading what a video gives before there is a template."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from PIL import Image

from toile.errors import InputError
from toile.preparation.template_making.intrinsics import Intrinsics
from toile.preparation.template_making.still import read_still

NUMBERS = Intrinsics(None, 420.0, 410.0, 163.0, 117.5)


@pytest.fixture
def folder(curved_sheet, tmp_path: Path) -> Path:
    return curved_sheet.write_video(tmp_path / "scene", n_frames=3)


def read(folder: Path, intrinsics: Intrinsics = NUMBERS, fps: float | None = None):
    return read_still(folder, intrinsics, fps=fps, minimum_component=0.1)


def test_what_is_read(folder) -> None:
    still = read(folder)
    assert (still.fps, still.n_frames) == (30, 3)
    assert still.frame.shape == (240, 320, 3)
    assert set(still.mask.unique().tolist()) == {0, 1}
    assert (still.camera.fx, still.camera.width) == (420, 320)


def test_frame_rate_given_by_hand(folder) -> None:
    assert read(folder, fps=25).fps == 25
    (folder / "video.json").unlink()
    assert read(folder, fps=25).fps == 25
    with pytest.raises(InputError, match="Frame rate is not known"):
        read(folder)


@pytest.mark.parametrize("text", ["{", "[]", "{}", '{"fps": "fast"}'])
def test_bad_video_json(folder, text) -> None:
    (folder / "video.json").write_text(text)
    with pytest.raises(InputError, match=r"video\.json cannot be understood"):
        read(folder)


@pytest.mark.parametrize("fps", [0, -3, float("nan")])
def test_bad_frame_rate(folder, fps) -> None:
    with pytest.raises(InputError, match="Frame rate is not positive"):
        read(folder, fps=fps)


def test_sizes_that_disagree(folder) -> None:
    (folder / "video.json").write_text(json.dumps({"fps": 30, "width": 640, "height": 480}))
    with pytest.raises(InputError, match="differ in size"):
        read(folder)
    Image.new("L", (100, 100), 255).save(folder / "masks" / "mask_000.png")
    with pytest.raises(InputError, match="Mask and frame differ"):
        read(folder)


def test_missing_and_empty_images(folder) -> None:
    (folder / "masks" / "mask_001.png").unlink()
    with pytest.raises(InputError, match=r"mask_001\.png is missing"):
        read(folder)
    Image.new("L", (320, 240)).save(folder / "masks" / "mask_000.png")
    with pytest.raises(InputError, match="Mask is empty"):
        read(folder)
    (folder / "rgbs" / "rgb_000.png").unlink()
    with pytest.raises(InputError, match=r"rgb_000\.png is missing"):
        read(folder)


@pytest.mark.parametrize(
    "description",
    [
        {"K": [[420.0, 0, 163.0], [0, 410.0, 117.5], [0, 0, 1]], "image_size": [240, 320]},
        # As the calibration of docs/video.md writes it.
        {"K": [[420.0, 0, 163.0], [0, 410.0, 117.5], [0, 0, 1]], "width": 320, "height": 240},
        {"focal_length": [420.0, 410.0], "optical_center": [163.0, 117.5]},
    ],
)
def test_camera_files_of_both_layouts(folder, description, tmp_path) -> None:
    file = tmp_path / "camera.json"
    file.write_text(json.dumps(description))
    assert read(folder, Intrinsics(file)).camera == read(folder).camera
    assert read(folder, Intrinsics(file, fx=500.0)).camera.fx == 500


@pytest.mark.parametrize(
    ("description", "said"),
    [
        ({"focal_length": [420.0, 410.0]}, "cannot be understood"),
        ({"K": [[420.0, 0.0], [0.0, 410.0]]}, "cannot be understood"),
        ({"K": [[420.0, 3.0, 163.0], [0, 410.0, 117.5], [0, 0, 1]]}, "skew"),
        (
            {"focal_length": [420.0, 410.0], "optical_center": [163.0, 117.5], "image_size": [1, 2]},
            "another size",
        ),
        (
            {"K": [[840.0, 0, 326.0], [0, 820.0, 235.0], [0, 0, 1]], "width": 640, "height": 480},
            "480 x 640",
        ),
        ({"K": [[840.0, 0, 326.0], [0, 820.0, 235.0], [0, 0, 1]], "width": 640}, "height"),
        ({"focal_length": [-420.0, 410.0], "optical_center": [163.0, 117.5]}, "not positive"),
    ],
)
def test_bad_camera_files(folder, description, said, tmp_path) -> None:
    file = tmp_path / "camera.json"
    file.write_text(json.dumps(description))
    with pytest.raises(InputError, match=said):
        read(folder, Intrinsics(file))


def test_missing_intrinsics(folder, tmp_path) -> None:
    with pytest.raises(InputError, match="no fy, cy"):
        read(folder, Intrinsics(None, fx=400.0, cx=160.0))
    with pytest.raises(InputError, match="Camera file is missing"):
        read(folder, Intrinsics(tmp_path / "none.json"))
