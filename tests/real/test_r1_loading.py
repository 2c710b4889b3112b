"""The measured conventions of the real and the independent scenes hold after loading.

The data is found in ``$TOILE_DATA`` (default ``./data``): phi_sft/ and independent/.
"""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from scipy.spatial import cKDTree

from toile.errors import InputError
from toile.scenes.doctor import diagnose
from toile.scenes.findings import Severity
from toile.scenes.registry import available_scenes, data_folder, load_scene, load_template
from toile.scenes.scene import Scene
from toile.scenes.texture_coordinates import from_file, projected
from toile.scenes.validation import silhouette_overlap

INDEPENDENT = "a1cb40"


@pytest.fixture(scope="module")
def data() -> Path:
    return data_folder()


@pytest.fixture(scope="module")
def r1(data: Path) -> Scene:
    if not (data / "phi_sft" / "R1" / "rgbs").is_dir():
        pytest.skip(f"scene R1 is not in {data} (set TOILE_DATA)")
    return load_scene("R1", data, texture_coordinates=from_file)


@pytest.fixture(scope="module")
def independent(data: Path) -> Scene:
    if INDEPENDENT not in available_scenes(data):
        pytest.skip(f"scene {INDEPENDENT} is not in {data} (set TOILE_DATA)")
    return load_scene(INDEPENDENT, data, n_frames=3)


@pytest.fixture
def withheld(data: Path) -> list[str]:
    names = [n for n, at in available_scenes(data).items() if at.folder.parent.name == "withheld"]
    if not names:
        pytest.skip(f"independent/withheld is not in {data} (set TOILE_DATA)")
    return names


def texture_error(scene: Scene) -> float:
    """Mean distance [px of the original image] of the texture coordinates from the projected template."""
    h, w = scene.original_size
    top, left = scene.crop
    pixels = scene.camera.project(scene.template) + torch.tensor([left, top])
    return float((scene.texture_coordinates * torch.tensor([w, h]) - pixels).norm(dim=-1).mean())


def test_r1_is_complete_and_cropped(r1: Scene) -> None:
    assert r1.n_frames == 50
    assert any("n_images says 49" in note for note in r1.notes)
    assert r1.original_size == (1080, 1920)
    assert r1.frames.shape == (50, r1.camera.height, r1.camera.width, 3)
    # 24 px around the masks: a fraction of the 1080 x 1920 image.
    assert r1.camera.height < 540
    assert r1.camera.width < 540
    assert r1.pinned_vertices == (0, 992)


def test_r1_template_projects_into_mask_0(r1: Scene) -> None:
    iou, inside = silhouette_overlap(r1.template, r1.camera, r1.masks[0])
    assert inside > 0.95
    assert iou > 0.95


def test_r1_feet_are_gone(r1: Scene) -> None:
    from scipy import ndimage

    assert any("dropped" in note for note in r1.notes)
    assert all(ndimage.label(mask.numpy())[1] == 1 for mask in r1.masks)


def test_r1_ground_truth_starts_at_the_template(r1: Scene) -> None:
    assert r1.ground_truth is not None
    assert r1.ground_truth.point_clouds is not None
    assert len(r1.ground_truth.point_clouds) == 50
    cloud = r1.ground_truth.point_clouds[0].numpy()
    distance, _ = cKDTree(cloud).query(r1.template.reshape(-1, 3).numpy())
    assert distance.mean() < 0.005
    assert (distance < 0.01).mean() > 0.95
    back, _ = cKDTree(r1.template.reshape(-1, 3).numpy()).query(cloud)
    assert (back < 0.0185).mean() > 0.99  # the half diagonal of a cell (12.5 mm) and 6 mm noise


def test_r1_texture_is_frame_0_upright(r1: Scene) -> None:
    top, left = r1.crop
    h, w = r1.frames.shape[1:3]
    assert torch.equal(r1.texture[top : top + h, left : left + w], r1.frames[0])


def test_r1_texture_coordinates_disagree_with_the_projection_by_4_8_px(r1: Scene) -> None:
    assert texture_error(r1) == pytest.approx(4.83, abs=0.05)
    assert any("4.83 px" in note for note in r1.notes)


def test_r1_projected_texture_coordinates_agree(r1: Scene, data: Path) -> None:
    scene = load_scene("R1", data, n_frames=1, texture_coordinates=projected)
    assert texture_error(scene) < 1e-3
    assert torch.equal(scene.texture, r1.texture)
    assert not any("disagree" in note for note in scene.notes)


def test_r1_doctor_has_no_errors(r1: Scene, data: Path) -> None:
    findings = diagnose("R1", data)
    assert not [f for f in findings if f.severity is Severity.ERROR]
    assert any("Edge lengths" in f.what for f in findings)


def test_independent_scene_keeps_its_conventions(independent: Scene) -> None:
    iou, inside = silhouette_overlap(independent.template, independent.camera, independent.masks[0])
    assert inside > 0.95
    assert iou > 0.95
    assert texture_error(independent) < 0.01
    assert independent.ground_truth is not None
    assert independent.ground_truth.vertices is not None
    assert independent.ground_truth.vertices.shape == (3, 32, 32, 3)
    assert torch.allclose(independent.ground_truth.vertices[0], independent.template, atol=1e-5)


def test_withheld_scenes_load_without_ground_truth(withheld: list[str], data: Path) -> None:
    for name in withheld:
        scene = load_scene(name, data, n_frames=1)
        assert scene.ground_truth is None
        assert silhouette_overlap(scene.template, scene.camera, scene.masks[0])[1] > 0.95


@pytest.mark.parametrize("number", range(1, 10))
def test_templates_are_upright_textured_grids(number: int, data: Path) -> None:
    name = f"R{number}"
    if not (data / "phi_sft" / "scenes" / f"{name}.json").is_file():
        pytest.skip(f"template {name} is not in {data} (set TOILE_DATA)")
    template = load_template(name, data)
    size = torch.tensor([template.camera.width, template.camera.height])
    error = (template.texture_coordinates * size - template.camera.project(template.positions)).norm(dim=-1)
    assert float(error.mean()) < 10
    pinned = template.positions.reshape(-1, 3)[list(template.pinned_vertices)]
    assert float(pinned[:, 1].max()) < float(template.positions[..., 1].mean())
    assert template.texture.shape[:2] == (template.camera.height, template.camera.width)


def test_r2_has_no_frames(data: Path) -> None:
    if "R2" not in available_scenes(data) or (data / "phi_sft" / "R2" / "rgbs").is_dir():
        pytest.skip(f"scene R2 without a video is not in {data} (set TOILE_DATA)")
    with pytest.raises(InputError, match=r"(?s)R2 has no frames.*only the template and texture"):
        load_scene("R2", data)
