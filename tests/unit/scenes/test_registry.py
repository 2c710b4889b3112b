from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import torch

from toile.errors import InputError
from toile.geometry.io import write_mesh, write_point_cloud
from toile.scenes.doctor import diagnose
from toile.scenes.findings import Severity
from toile.scenes.images import write_image
from toile.scenes.registry import available_scenes, data_folder, find_scene, load_scene, load_template
from toile.scenes.texture_coordinates import project_coordinates, projected

H = W = 32
HEIGHT, WIDTH = 90, 160


@pytest.fixture
def data(tmp_path: Path, tiny_folder: Path) -> Path:
    """A data folder with a complete R1, an R2 without a video and a native scene."""
    root = tmp_path / "data"
    shutil.copytree(tiny_folder, root / "generated" / "tiny")
    for name in ("R1", "R2"):
        write_published_scene(root / "phi_sft", name, n_frames=3 if name == "R1" else 0)
    return root


def write_published_scene(root: Path, name: str, n_frames: int) -> None:
    """A flat cloth in the published layout and conventions."""
    from toile.geometry.camera import Camera

    i, j = torch.meshgrid(torch.arange(H), torch.arange(W), indexing="ij")
    opencv = torch.stack((-0.3 + i * 0.5 / 31, -0.3 + j * 0.5 / 31, torch.full_like(i, 1) * 1.1), -1).double()
    camera = Camera(90.0, 88.0, 82.0, 46.0, HEIGHT, WIDTH)
    uv = project_coordinates(opencv, camera).double()
    k = torch.arange(H * W).reshape(H, W)
    quads = torch.stack((k[:-1, :-1], k[1:, :-1], k[1:, 1:], k[:-1, 1:]), -1).reshape(-1, 4).tolist()
    (root / "scenes").mkdir(parents=True, exist_ok=True)
    folder = root / name
    folder.mkdir()
    flat = opencv.reshape(-1, 3) * torch.tensor([-1.0, -1.0, 1.0])
    write_mesh(folder / f"0_{name}_quad.obj", flat, quads, uv.reshape(-1, 2))
    frame = torch.rand(HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(1))
    write_image(folder / "texture.png", frame.flip(0))
    mask = torch.zeros(HEIGHT, WIDTH)
    (x0, y0), (x1, y1) = (uv[i, i] * torch.tensor([WIDTH, HEIGHT]) for i in (0, -1))
    mask[round(float(y0)) : round(float(y1)), round(float(x0)) : round(float(x1))] = 1
    for number in range(n_frames):
        for kind, prefix, picture in (("rgbs", "rgb", frame), ("masks", "mask", mask)):
            (folder / kind).mkdir(exist_ok=True)
            write_image(folder / kind / f"{prefix}_{number:03d}.png", picture)
        (root / "ground_truth" / name).mkdir(parents=True, exist_ok=True)
        cloud = root / "ground_truth" / name / f"point_cloud_{number:03d}.pt"
        write_point_cloud(cloud, opencv.reshape(-1, 3).float())
    description = {
        "scene": name,
        "n_images": 2,
        "mesh_file": f"../data/{name}/0_{name}_quad.obj",
        "mesh_size": 0.5,
        "texture_file": f"../data/{name}/texture.png",
        "image_files": f"../data/{name}/rgbs/rgb_",
        "mask_files": f"../data/{name}/masks/mask_",
        "ground_truth_dir": f"../evaluation/{name}/ground_truth/",
        "optical_center": [camera.cx, camera.cy],
        "focal_length": [camera.fx, camera.fy],
        "image_size": [HEIGHT, WIDTH],
    }
    (root / "scenes" / f"{name}.json").write_text(json.dumps(description))


def test_published_layout_is_converted(data: Path) -> None:
    scene = load_scene("R1", data)
    assert scene.n_frames == 3
    assert any("n_images says 2" in note for note in scene.notes)
    assert scene.template[0, 0].tolist() == pytest.approx([-0.3, -0.3, 1.1])
    assert scene.texture_coordinates.dtype == torch.float32
    top, left = scene.crop
    h, w = scene.frames.shape[1:3]
    assert torch.equal(scene.texture[top : top + h, left : left + w], scene.frames[0])
    assert scene.gravity.tolist() == [0.0, 9.81, 0.0]
    assert (scene.fps, scene.pinned_vertices, scene.cloth_size) == (50.0, (0, 992), (0.5, 0.5))
    assert scene.ground_truth is not None
    assert scene.ground_truth.point_clouds is not None
    assert torch.allclose(scene.ground_truth.point_clouds[0].double(), scene.template.reshape(-1, 3))


def test_arguments_reach_the_published_layout(data: Path) -> None:
    scene = load_scene(
        "R1",
        data,
        n_frames=2,
        fps=30,
        gravity=(0, 9.8, 0.3),
        pinned_vertices=(0,),
        texture_coordinates=projected,
    )
    assert (scene.n_frames, scene.fps, scene.pinned_vertices) == (2, 30.0, (0,))
    assert scene.gravity.tolist() == [0.0, 9.8, 0.3]


def test_layout_of_the_published_repository_is_found_too(data: Path) -> None:
    repository = data / "phi_sft"
    (repository / "data").mkdir()
    (repository / "R1").rename(repository / "data" / "R1")
    (repository / "evaluation" / "R1").mkdir(parents=True)
    (repository / "ground_truth" / "R1").rename(repository / "evaluation" / "R1" / "ground_truth")
    scene = load_scene("R1", data)
    assert scene.ground_truth is not None


@pytest.mark.parametrize(
    ("missing", "text"),
    [
        ("R1/rgbs/rgb_001.png", "rgb_001.png is missing"),
        ("R1/masks/mask_002.png", "mask_002.png is missing"),
        ("ground_truth/R1/point_cloud_000.pt", "point_cloud_000.pt is missing"),
        ("R1/texture.png", "texture.png is missing"),
        ("R1/0_R1_quad.obj", "0_R1_quad.obj is missing"),
    ],
)
def test_a_gap_in_the_published_layout_names_the_file(data: Path, missing: str, text: str) -> None:
    (data / "phi_sft" / missing).unlink()
    with pytest.raises(InputError, match=text):
        load_scene("R1", data)
    assert any(text in f.what for f in diagnose("R1", data) if f.severity is Severity.ERROR)


def test_exchanged_optical_center_is_recognised(data: Path) -> None:
    path = data / "phi_sft" / "scenes" / "R1.json"
    description = json.loads(path.read_text())
    description["optical_center"] = description["optical_center"][::-1]
    path.write_text(json.dumps(description))
    with pytest.raises(InputError, match="cx and cy are exchanged"):
        load_scene("R1", data)


@pytest.mark.parametrize("key", ["mesh_size", "focal_length", "image_files"])
def test_a_missing_key_is_named(data: Path, key: str) -> None:
    path = data / "phi_sft" / "scenes" / "R1.json"
    description = json.loads(path.read_text())
    del description[key]
    path.write_text(json.dumps(description))
    with pytest.raises(InputError, match=f"Key '{key}' is missing"):
        load_scene("R1", data)


def test_a_scene_without_a_video_says_so_and_still_gives_its_template(data: Path) -> None:
    with pytest.raises(InputError, match=r"(?s)R2 has no frames.*only the template and texture"):
        load_scene("R2", data)
    template = load_template("R2", data)
    assert template.grid == (32, 32)
    assert template.positions.shape == (32, 32, 3)
    assert template.faces.shape == (2 * 31 * 31, 3)
    assert (template.camera.height, template.camera.width) == template.texture.shape[:2]
    expected = project_coordinates(template.positions, template.camera)
    assert torch.allclose(template.texture_coordinates, expected, atol=1e-6)


def test_native_scenes_are_found_by_name_and_by_path(data: Path, tiny_folder: Path) -> None:
    assert list(available_scenes(data)) == ["R1", "R2", "tiny"]
    assert find_scene("tiny", data).folder == data / "generated" / "tiny"
    assert load_scene("tiny", data).name == "tiny"
    assert load_scene(tiny_folder, data).source == tiny_folder
    assert load_scene("generated/tiny", data).name == "tiny"
    with pytest.raises(InputError, match="no separate template"):
        load_template("tiny", data)


def test_an_unknown_scene_lists_those_there_are(data: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="R1, R2, tiny"):
        load_scene("R10", data)
    with pytest.raises(InputError, match="TOILE_DATA"):
        load_scene("R1", tmp_path / "nowhere")


def test_data_folder_comes_from_argument_then_environment_then_default(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("TOILE_DATA", "/from/environment")
    assert data_folder("/given") == Path("/given")
    assert data_folder() == Path("/from/environment")
    monkeypatch.delenv("TOILE_DATA")
    assert data_folder() == Path("data")
