from __future__ import annotations

import json
from dataclasses import fields, replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from toile.errors import InputError
from toile.scenes.doctor import diagnose_folder
from toile.scenes.findings import Severity
from toile.scenes.images import write_image
from toile.scenes.native import load_native, write_native
from toile.scenes.scene import GroundTruth, Scene
from toile.scenes.texture_coordinates import from_file, projected
from toile.scenes.validation import check_scene, uncropped_camera


def assert_same(a: object, b: object) -> None:
    if isinstance(a, Tensor):
        assert isinstance(b, Tensor)
        assert a.dtype == b.dtype
        assert torch.equal(a, b)
    elif isinstance(a, tuple):
        assert isinstance(b, tuple)
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            assert_same(x, y)
    elif isinstance(a, GroundTruth):
        assert isinstance(b, GroundTruth)
        assert_same((a.vertices, a.point_clouds), (b.vertices, b.point_clouds))
    else:
        assert a == b


def test_loading_what_was_written_gives_the_same_scene(tiny_scene: Scene, tmp_path: Path) -> None:
    folder = write_native(tiny_scene, tmp_path / "scene")
    loaded = load_native(folder, crop_margin=None)
    assert loaded.source == folder
    assert ["Few frames" in note for note in loaded.notes] == [True]
    for field in fields(Scene):
        if field.name not in ("source", "notes"):
            assert_same(getattr(tiny_scene, field.name), getattr(loaded, field.name))


def test_a_cropped_scene_survives_the_round_trip_and_keeps_its_place(
    tiny_folder: Path, tmp_path: Path
) -> None:
    cropped = load_native(tiny_folder, crop_margin=3)
    again = load_native(write_native(cropped, tmp_path / "cropped"), crop_margin=3)
    for name in ("frames", "masks", "template", "texture_coordinates"):
        assert_same(getattr(cropped, name), getattr(again, name))
    assert (again.crop, again.original_size) == (cropped.crop, cropped.original_size)
    assert again.camera == cropped.camera


def test_a_crop_alone_says_how_large_the_original_was_at_least(tiny_scene: Scene, tiny_folder: Path) -> None:
    file = tiny_folder / "scene.json"
    description = json.loads(file.read_text())
    description["crop"] = [10, 5]
    description.pop("original_size", None)
    file.write_text(json.dumps(description))
    height, width = tiny_scene.masks.shape[1:]
    scene = load_native(tiny_folder, crop_margin=None)
    assert (scene.crop, scene.original_size) == ((10, 5), (10 + height, 5 + width))
    for bad in ({"crop": [-3, 0]}, {"crop": [10, 5], "original_size": [height, width]}):
        file.write_text(json.dumps({**description, **bad}))
        with pytest.raises(InputError, match="crop"):
            load_native(tiny_folder, crop_margin=None)


def test_cropping_shifts_camera_and_images_together(tiny_scene: Scene, tiny_folder: Path) -> None:
    scene = load_native(tiny_folder, crop_margin=5)
    top, left = scene.crop
    h, w = scene.frames.shape[1:3]
    assert top > 0
    assert left > 0
    assert (scene.camera.height, scene.camera.width) == (h, w)
    assert torch.equal(scene.frames, tiny_scene.frames[:, top : top + h, left : left + w])
    shift = tiny_scene.camera.project(scene.template) - scene.camera.project(scene.template)
    assert torch.allclose(shift, torch.tensor([left, top], dtype=torch.float64))
    union = tiny_scene.masks.amax(0)
    rows, columns = union.any(1).nonzero(), union.any(0).nonzero()
    assert top == int(rows[0]) - 5
    assert top + h == int(rows[-1]) + 1 + 5
    assert left == int(columns[0]) - 5
    assert left + w == int(columns[-1]) + 1 + 5
    assert uncropped_camera(scene) == tiny_scene.camera


def test_crop_is_clipped_to_the_image(tiny_scene: Scene, tiny_folder: Path) -> None:
    scene = load_native(tiny_folder, crop_margin=1000)
    assert scene.frames.shape == tiny_scene.frames.shape
    assert scene.crop == (0, 0)


def test_only_the_first_frames_are_loaded_with_their_ground_truth(tiny_folder: Path) -> None:
    (tiny_folder / "rgbs" / "rgb_003.png").unlink()
    scene = load_native(tiny_folder, n_frames=2)
    assert scene.n_frames == len(scene.masks) == 2
    assert scene.ground_truth is not None
    assert scene.ground_truth.vertices is not None
    assert scene.ground_truth.vertices.shape == (2, 6, 5, 3)
    assert scene.ground_truth.point_clouds is not None
    assert len(scene.ground_truth.point_clouds) == 2
    with pytest.raises(InputError, match="between 1 and 4"):
        load_native(tiny_folder, n_frames=5)


def test_small_mask_components_are_dropped_and_noted(tiny_scene: Scene, tmp_path: Path) -> None:
    masks = tiny_scene.masks.clone()
    cloth = masks[1].clone()
    masks[1, 75:78, 2:5] = 1.0
    folder = write_native(replace(tiny_scene, masks=masks), tmp_path / "feet")
    scene = load_native(folder, crop_margin=None)
    assert torch.equal(scene.masks[1], cloth)
    assert any("dropped 1 components" in note and "9 px" in note for note in scene.notes)
    assert torch.equal(load_native(folder, crop_margin=None, minimum_component=0.0).masks, masks)


def test_a_large_second_component_stays(tiny_scene: Scene, tmp_path: Path) -> None:
    masks = tiny_scene.masks.clone()
    size = int(masks[1].sum())
    rows = -(-size // 10 // 10) + 1
    masks[1, :rows, 105:115] = 1.0
    folder = write_native(replace(tiny_scene, masks=masks), tmp_path / "two")
    assert torch.equal(load_native(folder, crop_margin=None).masks, masks)


def test_frames_are_not_blackened_outside_the_mask(tiny_scene: Scene, tiny_folder: Path) -> None:
    scene = load_native(tiny_folder, crop_margin=None)
    assert torch.equal(scene.frames[0], tiny_scene.frames[0])


def test_projected_coordinates_make_frame_0_the_texture(tiny_scene: Scene, tmp_path: Path) -> None:
    off = replace(tiny_scene, texture_coordinates=tiny_scene.texture_coordinates + 0.05)
    folder = write_native(off, tmp_path / "off")
    given = load_native(folder, texture_coordinates=from_file)
    assert torch.equal(given.texture_coordinates, off.texture_coordinates)
    assert any("disagree with the projected template" in note and "px" in note for note in given.notes)
    scene = load_native(folder, texture_coordinates=projected)
    assert ["Few frames" in note for note in scene.notes] == [True]
    assert torch.equal(scene.texture, tiny_scene.frames[0])
    size = torch.tensor([120.0, 80.0])
    top, left = scene.crop
    in_crop = scene.texture_coordinates * size - torch.tensor([left, top])
    assert torch.allclose(in_crop, scene.camera.project(scene.template).float(), atol=1e-4)


def test_arguments_replace_what_the_file_says(tiny_folder: Path) -> None:
    scene = load_native(tiny_folder, fps=50.0, gravity=(0.0, 9.8, 0.0), pinned_vertices=())
    assert scene.fps == 50.0
    assert scene.gravity.tolist() == [0.0, 9.8, 0.0]
    assert scene.pinned_vertices == ()


@pytest.mark.parametrize("pinned", [(), (2,), (0, 5, 10, 15, 20, 25)])
def test_any_number_of_pinned_vertices_is_fine(
    tiny_scene: Scene, tmp_path: Path, pinned: tuple[int, ...]
) -> None:
    folder = write_native(replace(tiny_scene, pinned_vertices=pinned), tmp_path / "pinned")
    assert load_native(folder).pinned_vertices == pinned


def test_scene_without_ground_truth(tiny_scene: Scene, tmp_path: Path) -> None:
    folder = write_native(replace(tiny_scene, ground_truth=None), tmp_path / "blind")
    assert not (folder / "ground_truth").exists()
    assert load_native(folder).ground_truth is None


def test_an_existing_folder_is_only_replaced_on_request(tiny_scene: Scene, tiny_folder: Path) -> None:
    (tiny_folder / "old.txt").write_text("old")
    with pytest.raises(InputError, match="overwrite=True"):
        write_native(tiny_scene, tiny_folder)
    write_native(tiny_scene, tiny_folder, overwrite=True)
    assert not (tiny_folder / "old.txt").exists()
    assert [p.name for p in tiny_folder.parent.iterdir()] == ["tiny"]


def test_a_failed_write_leaves_nothing(tiny_scene: Scene, tmp_path: Path) -> None:
    broken = replace(tiny_scene, masks=tiny_scene.masks[:2])
    with pytest.raises(ValueError, match="shorter"):
        write_native(broken, tmp_path / "scene")
    assert list(tmp_path.iterdir()) == []


def test_a_good_scene_has_no_errors_or_warnings(tiny_folder: Path) -> None:
    findings = check_scene(load_native(tiny_folder))
    assert {finding.severity for finding in findings} <= {Severity.INFO}


def test_surplus_frames_are_noted(tiny_scene: Scene, tiny_folder: Path) -> None:
    write_image(tiny_folder / "rgbs" / "rgb_004.png", tiny_scene.frames[0])
    scene = load_native(tiny_folder)
    assert scene.n_frames == 4
    assert any("rgb_004.png" in note for note in scene.notes)


TIMES = (0.0, 0.02, 0.04, 0.12)


@pytest.fixture
def uneven_folder(tiny_scene: Scene, tmp_path: Path) -> Path:
    """The tiny scene with frames 20, 20 and 80 ms apart."""
    uneven = replace(tiny_scene, times=torch.tensor(TIMES, dtype=torch.float64), fps=25.0)
    return write_native(uneven, tmp_path / "uneven")


def test_times_are_kept(uneven_folder: Path) -> None:
    scene = load_native(uneven_folder)
    assert scene.times is not None
    assert scene.times.tolist() == list(TIMES)
    assert scene.fps == pytest.approx(25)
    assert any("20 to 80 ms" in note for note in scene.notes)
    assert any("unevenly spaced" in f.what for f in diagnose_folder(uneven_folder))


def test_the_first_frames_have_their_own_rate(uneven_folder: Path) -> None:
    """Those are evenly spaced at 50 per second, whatever the mean rate of the clip is."""
    scene = load_native(uneven_folder, n_frames=3)
    assert scene.times is None
    assert scene.fps == pytest.approx(50)
    assert not any("unevenly" in note for note in scene.notes)


def test_a_rate_from_outside_replaces_the_times_and_says_so(uneven_folder: Path) -> None:
    scene = load_native(uneven_folder, fps=30.0)
    assert (scene.times, scene.fps) == (None, 30.0)
    assert any("fps replaces the times" in note for note in scene.notes)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"times": [0.0, 0.02, 0.04]}, "3 times for 4 frames"),
        ({"times": [0.0, 0.04, 0.02, 0.12]}, "frame 1 at 0.04 s, frame 2 at 0.02 s"),
        ({"times": [0.0, 0.02, "x", 0.12]}, "times"),
        ({"times": 0.02}, "times"),
        ({"fps": 240.0}, "fps 240"),
    ],
)
def test_wrong_times_in_the_description(uneven_folder: Path, changes, named) -> None:
    path = uneven_folder / "scene.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))
    with pytest.raises(InputError) as caught:
        load_native(uneven_folder)
    assert named in str(caught.value)


def test_long_clips_are_written_whole(tiny_scene: Scene, tmp_path: Path) -> None:
    """Where reading gives up on a long row of missing files, writing has all of them before it."""
    n = 60
    long = replace(
        tiny_scene,
        frames=tiny_scene.frames[:1].expand(n, -1, -1, -1),
        masks=tiny_scene.masks[:1].expand(n, -1, -1),
        ground_truth=None,
    )
    folder = write_native(long, tmp_path / "long")
    assert len(list((folder / "rgbs").iterdir())) == len(list((folder / "masks").iterdir())) == n
    assert load_native(folder, crop_margin=None).n_frames == n
