"""Recordings by several cameras: native layout, EasyMocap's layout, and what can be wrong with them."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from toile.errors import InputError
from toile.evaluation.evaluate import evaluate
from toile.geometry.camera import Camera, looking_at
from toile.scenes.doctor import diagnose_folder
from toile.scenes.findings import Severity
from toile.scenes.images import write_image
from toile.scenes.multi_view import load_multi_view
from toile.scenes.native import load_native, write_native
from toile.scenes.native_views import entry_of
from toile.scenes.registry import load_scene
from toile.scenes.scene import Scene
from toile.scenes.views import BODY_25, View

PLAIN = Camera(60.0, 60.0, 32.0, 24.0, 48, 64)
N_FRAMES = 3


def ring(n: int) -> list[Camera]:
    up, middle = torch.tensor([0.0, 1.0, 0.0]), torch.tensor([0.0, 1.0, 0.0])
    angles = [2 * math.pi * k / n for k in range(n)]
    return [
        looking_at(PLAIN, torch.tensor([3 * math.sin(a), 1.4, 3 * math.cos(a)]), middle, up) for a in angles
    ]


def write_images(folder: Path, pattern: str, value: float, channels: tuple[int, ...] = ()) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for k in range(N_FRAMES):
        image = torch.zeros(48, 64, *channels)
        image[10:40, 20:44] = value
        write_image(folder / (pattern % k), image)


@pytest.fixture
def native(tmp_path: Path) -> Path:
    """Four cameras without a cloth, landmarks of two names."""
    folder = tmp_path / "person"
    entries = []
    for k, camera in enumerate(ring(4)):
        write_images(folder / f"c{k}", "rgb_%03d.png", 0.5, (3,))
        write_images(folder / f"c{k}", "mask_%03d.png", 1.0)
        np.save(folder / f"c{k}" / "landmarks.npy", np.full((N_FRAMES, 2, 3), k + 0.5, np.float32))
        files = {
            "rgb": f"c{k}/rgb_%03d.png",
            "mask": f"c{k}/mask_%03d.png",
            "landmarks": f"c{k}/landmarks.npy",
        }
        entries.append(entry_of(View(f"c{k}", camera), files))
    description = {
        "fps": 25.0,
        "n_frames": N_FRAMES,
        "units": "metres",
        "landmarks": ["nose", "left_hip"],
        "cameras": entries,
    }
    (folder / "scene.json").write_text(json.dumps(description))
    return folder


@pytest.fixture
def mocap(tmp_path: Path) -> Path:
    """Four cameras in EasyMocap's layout, z up, OpenPose's landmarks."""
    folder = tmp_path / "mocap"
    folder.mkdir()
    intrinsics = cv2.FileStorage(str(folder / "intri.yml"), cv2.FILE_STORAGE_WRITE)
    extrinsics = cv2.FileStorage(str(folder / "extri.yml"), cv2.FILE_STORAGE_WRITE)
    names = [f"0{k + 1}" for k in range(4)]
    for storage in (intrinsics, extrinsics):
        storage.startWriteStruct("names", cv2.FILE_NODE_SEQ)
        for name in names:
            storage.write("", name)
        storage.endWriteStruct()
    y_up = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # z up to y up
    for name, camera in zip(names, ring(4), strict=True):
        K = camera.K.numpy().copy()
        K[:2, 2] -= 0.5
        intrinsics.write(f"K_{name}", K)
        intrinsics.write(f"dist_{name}", np.zeros((1, 5)))
        R = camera.R.numpy() @ y_up
        extrinsics.write(f"R_{name}", cv2.Rodrigues(R)[0])
        extrinsics.write(f"T_{name}", camera.t.numpy()[:, None])
        write_images(folder / "images" / name, "%06d.png", 0.5, (3,))
        write_images(folder / "mask" / name, "%06d.png", 1.0)
        (folder / "openpose" / name).mkdir(parents=True)
        for k in range(N_FRAMES):
            people = [[3.0, 4.0, 0.1] * 25, [10.0 + k, 20.0, 0.9] * 25]
            content = {"version": 1.3, "people": [{"pose_keypoints_2d": p} for p in people]}
            (folder / "openpose" / name / f"{k:06d}_keypoints.json").write_text(json.dumps(content))
    intrinsics.release()
    extrinsics.release()
    return folder


def test_native_cameras_are_read_with_poses_images_and_landmarks(native: Path) -> None:
    recording = load_multi_view(native)
    assert recording.cameras == tuple(ring(4))
    assert recording.n_frames == N_FRAMES
    assert recording.views[1].frame(2)[20, 30].tolist() == pytest.approx([128 / 255] * 3)
    assert recording.views[1].mask(0).sum() == 30 * 24
    assert recording.landmarks(["left_hip"]).shape == (4, N_FRAMES, 1, 3)
    assert recording.landmarks(["left_hip"])[3, 0, 0, 0] == 3.5
    assert load_multi_view(native, n_frames=2).views[0].n_frames == 2


def test_a_recording_without_a_cloth_is_no_scene(native: Path) -> None:
    with pytest.raises(InputError, match="Scene has no cloth"):
        load_native(native)


def test_easymocap_gives_the_same_cameras_with_y_up(mocap: Path) -> None:
    recording = load_multi_view(mocap, fps=30)
    point = torch.tensor([0.2, 1.1, 0.3], dtype=torch.float64)
    for found, true in zip(recording.cameras, ring(4), strict=True):
        torch.testing.assert_close(found.project(point), true.project(point), atol=1e-8, rtol=0)
    assert recording.landmark_names == BODY_25
    # The surer of two people; OpenPose counts from the centre of a pixel.
    torch.testing.assert_close(recording.views[0].landmarks[2, 7], torch.tensor([12.5, 20.5, 0.9]))
    assert ["several people" in note for note in recording.notes] == [True]


def test_easymocap_needs_a_frame_rate(mocap: Path) -> None:
    with pytest.raises(InputError, match="Frame rate"):
        load_multi_view(mocap)


def test_distortion_is_taken_out_of_images_and_landmarks(mocap: Path) -> None:
    text = (mocap / "intri.yml").read_text()
    assert "0., 0., 0., 0., 0." in text
    (mocap / "intri.yml").write_text(text.replace("0., 0., 0., 0., 0.", "-0.3, 0., 0., 0., 0."))
    view = load_multi_view(mocap, fps=30).views[0]
    K = view.camera.K.numpy()
    x = np.array([10.5, 20.5])  # of the first frame's landmarks, toile's pixels
    straight = (view.landmarks[0, 0, :2].double().numpy() - K[:2, 2]) / K[[0, 1], [0, 1]]
    bent = straight * (1 - 0.3 * (straight**2).sum())
    assert bent * K[[0, 1], [0, 1]] + K[:2, 2] == pytest.approx(x, abs=1e-3)
    # A barrel's corners move out when it is taken away: the rectangle grows.
    assert view.mask(0).sum() > 30 * 24


def emptied(folder: Path, native: bool) -> None:
    write_images(folder / ("c2" if native else "mask/03"), "mask_%03d.png" if native else "%06d.png", 0.0)


def a_frame_less(folder: Path, native: bool) -> None:
    for place in ("images", "mask"):
        (folder / place / "02" / "000002.png").unlink()
    (folder / "openpose" / "02" / "000002_keypoints.json").unlink()


def another_skeleton(folder: Path, native: bool) -> None:
    content = {"people": [{"pose_keypoints_2d": [1.0, 2.0, 0.5] * 18}]}
    (folder / "openpose" / "01" / "000001_keypoints.json").write_text(json.dumps(content))


def a_camera_gone(folder: Path, native: bool) -> None:
    text = (folder / "extri.yml").read_text()
    (folder / "extri.yml").write_text(text.replace("T_03", "T_09"))


def no_calibration(folder: Path, native: bool) -> None:
    (folder / "extri.yml").write_text("not: [a storage")


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (emptied, "Camera sees nothing"),
        (a_frame_less, "Cameras differ in their frames"),
        (another_skeleton, "Landmarks are of another skeleton"),
        (a_camera_gone, "Calibration lacks a matrix"),
        (no_calibration, "Calibration cannot be read"),
    ],
)
def test_what_is_wrong_with_a_recording_is_named(
    mocap: Path, spoil: Callable[[Path, bool], None], message: str
) -> None:
    spoil(mocap, False)
    with pytest.raises(InputError, match=message):
        load_multi_view(mocap, fps=30)
    assert [f.what for f in diagnose_folder(mocap) if f.severity is Severity.ERROR] == [message]


def spoiled(folder: Path, **changes: object) -> None:
    description = json.loads((folder / "scene.json").read_text())
    description["cameras"][2].update(changes)
    (folder / "scene.json").write_text(json.dumps(description))


def test_what_is_wrong_with_native_cameras_is_named(native: Path) -> None:
    emptied(native, True)
    with pytest.raises(InputError, match="Camera sees nothing") as error:
        load_multi_view(native)
    assert "c2" in error.value.where
    spoiled(native, R=[[1.0, 0, 0], [0, 1, 0], [0, 0, -1]])
    with pytest.raises(InputError, match="rotation is none"):
        load_multi_view(native)
    spoiled(native, K=[[60.0, 1, 32], [0, 60, 24], [0, 0, 1]])
    with pytest.raises(InputError, match="Key 'cameras' cannot be understood"):
        load_multi_view(native)


@pytest.mark.parametrize("name", ["../../elsewhere", "a/b", "..", ""])
def test_a_camera_is_no_path(native: Path, name: str) -> None:
    """Scenes are written into folders by the names of their cameras."""
    description = json.loads((native / "scene.json").read_text())
    description["cameras"][1]["name"] = name
    (native / "scene.json").write_text(json.dumps(description))
    with pytest.raises(InputError, match="name"):
        load_multi_view(native)


def test_a_camera_that_looks_away_is_a_warning(native: Path) -> None:
    description = json.loads((native / "scene.json").read_text())
    turned = np.array(description["cameras"][2]["R"]) * [[-1], [1], [-1]]
    t = np.array(description["cameras"][2]["t"]) * [-1, 1, -1]
    spoiled(native, R=turned.tolist(), t=t.tolist())
    assert [f.what for f in diagnose_folder(native)] == ["Camera looks away"]


def test_landmarks_of_another_skeleton_are_refused(native: Path) -> None:
    with pytest.raises(InputError, match="another skeleton"):
        load_multi_view(native).landmarks(["left_hip", "tail"])


@pytest.fixture
def two_cameras(tiny_scene: Scene, tmp_path: Path) -> Path:
    """The tiny cloth with a second camera, whose world is not that of the first."""
    write_images(tmp_path / "second", "rgb_%03d.png", 0.5, (3,))
    write_images(tmp_path / "second", "mask_%03d.png", 1.0)
    scene = replace(tiny_scene, frames=tiny_scene.frames[:3], masks=tiny_scene.masks[:3], ground_truth=None)
    second = View(
        "side",
        looking_at(
            PLAIN, torch.tensor([1.0, 0.0, 1.2]), torch.tensor([0.0, 0, 1.2]), torch.tensor([0, -1.0, 0])
        ),
        tuple(tmp_path / "second" / f"rgb_{k:03d}.png" for k in range(3)),
        tuple(tmp_path / "second" / f"mask_{k:03d}.png" for k in range(3)),
    )
    return write_native(replace(scene, views=(second,)), tmp_path / "two")


def test_a_cloth_may_be_seen_by_several_cameras(two_cameras: Path) -> None:
    scene = load_native(two_cameras)
    assert [view.name for view in scene.views] == ["side"]
    middle = torch.tensor([0.0, 0.0, 1.2], dtype=torch.float64)
    torch.testing.assert_close(
        scene.cameras[1].project(middle), torch.tensor([32.0, 24.0], dtype=torch.float64)
    )
    assert scene.views[0].mask(1).sum() == 30 * 24
    # Poses are made relative to the first camera, in whose frame the cloth is.
    description = json.loads((two_cameras / "scene.json").read_text())
    moved = ring(1)[0]
    for entry in description["cameras"]:
        R, t = torch.tensor(entry["R"], dtype=torch.float64), torch.tensor(entry["t"], dtype=torch.float64)
        entry["R"], entry["t"] = (R @ moved.R).tolist(), (R @ moved.t + t).tolist()
    (two_cameras / "scene.json").write_text(json.dumps(description))
    again = load_native(two_cameras)
    torch.testing.assert_close(again.cameras[1].project(middle), scene.cameras[1].project(middle))


def test_what_works_on_one_view_refuses_several(two_cameras: Path) -> None:
    with pytest.raises(InputError, match="has several cameras") as error:
        load_scene(two_cameras)
    assert "side" in error.value.got
    scene = load_native(two_cameras)
    with pytest.raises(InputError, match="has several cameras"):
        evaluate(scene.template.expand(scene.n_frames, -1, -1, -1), scene)


def test_the_first_camera_must_be_the_scenes(two_cameras: Path) -> None:
    description = json.loads((two_cameras / "scene.json").read_text())
    description["cameras"].reverse()
    (two_cameras / "scene.json").write_text(json.dumps(description))
    with pytest.raises(InputError, match="First camera is not the scene's"):
        load_native(two_cameras)
