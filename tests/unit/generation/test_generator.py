from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from scipy import ndimage
from torch import Tensor

from toile.errors import InputError
from toile.generation.demo import DEMO
from toile.generation.discretization import deviation
from toile.generation.generator import generate
from toile.generation.motion import PinnedMotion, Swing
from toile.generation.settings import GeneratorSettings
from toile.generation.truth import TRUTH_FILE, read_truth, write
from toile.geometry.camera import Camera
from toile.geometry.mesh import grid_faces
from toile.scenes.findings import Severity
from toile.scenes.native import load_native
from toile.scenes.scene import Scene
from toile.scenes.template import Template
from toile.scenes.validation import check_scene

Generated = tuple[Scene, dict[str, Any]]


def vertices(scene: Scene) -> Tensor:
    assert scene.ground_truth is not None
    assert scene.ground_truth.vertices is not None
    return scene.ground_truth.vertices


def test_a_repetition_is_bit_identical(
    tiny: Generated, tiny_settings: GeneratorSettings, tiny_texture: Tensor
) -> None:
    scene, truth = generate(tiny_settings, tiny_texture)
    assert torch.equal(scene.frames, tiny[0].frames)
    assert torch.equal(scene.masks, tiny[0].masks)
    assert torch.equal(vertices(scene), vertices(tiny[0]))
    assert truth == tiny[1]


def test_another_seed_gives_another_scene(
    tiny: Generated, tiny_settings: GeneratorSettings, tiny_texture: Tensor
) -> None:
    scene, _ = generate(replace(tiny_settings, seed=4, n_frames=2), tiny_texture)
    assert float((vertices(scene)[0] - vertices(tiny[0])[0]).norm(dim=-1).max()) > 1e-3


def test_shapes_and_validity(tiny: Generated, tiny_settings: GeneratorSettings) -> None:
    scene, _ = tiny
    assert scene.frames.shape == (12, 90, 100, 3)
    assert scene.masks.shape == (12, 90, 100)
    assert set(scene.masks.unique().tolist()) == {0.0, 1.0}
    assert scene.grid == tiny_settings.grid
    assert torch.equal(scene.texture, scene.frames[0])
    assert torch.equal(scene.template, vertices(scene)[0])
    problems = [f for f in check_scene(scene) if f.severity is not Severity.INFO]
    assert problems == []


def test_background_is_black(tiny: Generated) -> None:
    scene, _ = tiny
    for frame, mask in zip(scene.frames, scene.masks, strict=True):
        outside = ~torch.from_numpy(ndimage.binary_dilation(mask.numpy() > 0.5, iterations=3))
        assert float(frame[outside].max()) == 0


def test_ground_truth_projects_into_the_masks(tiny: Generated) -> None:
    scene, _ = tiny
    for positions, mask in zip(vertices(scene), scene.masks, strict=True):
        wide = ndimage.binary_dilation(
            mask.numpy() > 0.5, iterations=2
        )  # pointed corners cover no whole pixel
        x, y = scene.camera.project(positions).floor().long().unbind(-1)
        assert wide[y.numpy(), x.numpy()].all()


def test_starts_at_rest_and_swings_visibly(tiny: Generated, tiny_settings: GeneratorSettings) -> None:
    scene, _ = tiny
    width = tiny_settings.cloth_size[0]
    moved = (vertices(scene) - vertices(scene)[0]).norm(dim=-1)
    # At rest under gravity alone, so in one frame the wind of 3.1 m/s² moves it by half of that times t²,
    # the free end of a hanging rod by three quarters.
    assert float(moved[1].max()) < 0.9 * 3.1 / tiny_settings.fps**2
    assert float(moved.mean((1, 2)).max()) > 0.05 * width
    out_of_plane = (vertices(scene) - vertices(scene)[0])[..., 2].abs()
    assert float(out_of_plane.max()) > 0.1 * width
    pinned = [(k // 8, k % 8) for k in scene.pinned_vertices]
    assert all(float(moved[:, i, j].max()) == 0 for i, j in pinned)


def test_pinned_vertices_follow_their_motion(tiny_settings: GeneratorSettings, tiny_texture: Tensor) -> None:
    motion = Swing(amplitude=(0.02, 0.0, 0.05), period=0.4)
    scene, truth = generate(replace(tiny_settings, pinned_motion=motion, n_frames=4), tiny_texture)
    times = torch.arange(4, dtype=torch.float64) / 25
    expected = vertices(scene)[0, 0, 0] + motion.displacement(times)
    torch.testing.assert_close(vertices(scene)[:, 0, 0], expected, atol=1e-12, rtol=0)
    assert truth["pinned_motion"] == {"kind": "Swing", "amplitude": [0.02, 0.0, 0.05], "period": 0.4}


def test_the_fit_grid_follows_the_demo() -> None:
    """The true parameters on its fit grid with 4 steps per frame: within 0.3 % of the width on average."""
    settings = replace(DEMO, n_frames=10, substeps=4)
    scene, _ = generate(settings, torch.full((8, 8, 3), 0.5))
    share = deviation(settings, scene, 4) / settings.cloth_size[0]
    assert float(share.mean()) < 0.003


def test_round_trip(tiny: Generated, tmp_path: Path) -> None:
    scene, truth = tiny
    folder = write(scene, truth, tmp_path / "deep" / "scene")
    read = load_native(folder, crop_margin=None)
    for name in ("frames", "masks", "texture", "texture_coordinates", "template", "gravity"):
        assert torch.equal(getattr(read, name), getattr(scene, name)), name
    for name in ("name", "camera", "cloth_size", "fps", "pinned_vertices", "crop", "original_size"):
        assert getattr(read, name) == getattr(scene, name), name
    assert torch.equal(vertices(read), vertices(scene))
    assert read_truth(folder) == truth
    assert list((tmp_path / "deep").iterdir()) == [folder]  # nothing is left over


def test_writing_over_a_folder_needs_consent(tiny: Generated, tmp_path: Path) -> None:
    scene, truth = tiny
    write(scene, truth, tmp_path / "scene")
    with pytest.raises(InputError, match="exists"):
        write(scene, truth, tmp_path / "scene")
    write(scene, {**truth, "format": 99}, tmp_path / "scene", overwrite=True)
    assert read_truth(tmp_path / "scene")["format"] == 99


def test_a_failed_write_leaves_nothing(tiny: Generated, tmp_path: Path) -> None:
    scene, _ = tiny
    with pytest.raises(TypeError):
        write(scene, {"wind": object()}, tmp_path / "scene")
    assert list(tmp_path.iterdir()) == []


def test_loading_does_not_open_the_truth(tiny: Generated, tmp_path: Path) -> None:
    scene, truth = tiny
    folder = write(scene, truth, tmp_path / "scene")
    (folder / TRUTH_FILE).write_text("not even JSON")
    load_native(folder)
    with pytest.raises(InputError, match="cannot be read"):
        read_truth(folder)


def test_truth_in_both_units(tiny: Generated, tiny_settings: GeneratorSettings) -> None:
    _, truth = tiny
    mass = 0.15 * 0.5 * 0.4 / 49
    assert truth["si"]["stretching"] == pytest.approx(3000 * mass * 25**2)
    assert truth["si"]["bending"] == pytest.approx(mass * 0.5 * 0.4 / 49 * 25**2)
    assert truth["si_simulated_grid"]["shearing"] == pytest.approx(truth["si"]["shearing"] / 4)
    assert truth["wind"] == [0.5, 0.0, 3.0]
    assert truth["simulated_grid"] == [15, 15]
    assert set(truth["settings"]) == {f.name for f in fields(tiny_settings)}


def test_from_a_real_template(tiny_settings: GeneratorSettings, tiny: Generated) -> None:
    """A stand-in for a scan: another scene's frame 0 plus noise, away from the middle of a large image."""
    scene, _ = tiny
    generator = torch.Generator().manual_seed(0)
    noisy = scene.template + 0.001 * torch.randn(8, 8, 3, dtype=torch.float64, generator=generator)
    template = Template(
        name="scan",
        positions=noisy + torch.tensor([0.3, -0.1, 0.2], dtype=torch.float64),
        faces=grid_faces(8, 8),
        texture=scene.texture,
        texture_coordinates=scene.texture_coordinates,
        cloth_size=(0.45, 0.45),
        camera=Camera(240.0, 240.0, 150.0, 150.0, 300, 400),
        pinned_vertices=scene.pinned_vertices,
    )
    settings = replace(tiny_settings, n_frames=3, crop_margin=6, image_scale=0.5)
    made, truth = generate(settings, template=template)
    assert truth["template"] == "scan"
    assert made.original_size == (150, 200)
    assert made.frames.shape[1] < 150
    assert made.crop[1] > 0
    assert made.cloth_size[0] == pytest.approx(0.5, rel=0.02)
    # It settles close to where the template is, and its pinned vertices stay exactly there.
    assert float((made.template - template.positions).norm(dim=-1).mean()) < 0.01
    assert torch.equal(made.template[0, 0], template.positions[0, 0])
    assert [f for f in check_scene(made) if f.severity is Severity.ERROR] == []
    # The print is the template's texture: colours at the vertices agree with its frame 0.
    inner = (slice(2, -2), slice(2, -2))
    uv = scene.texture_coordinates[inner] * torch.tensor([100.0, 90.0])
    x, y = uv.floor().long().unbind(-1)
    a, b = made.camera.project(made.template[inner]).floor().long().unbind(-1)
    assert float((scene.texture[y, x] - made.frames[0][b, a]).abs().mean()) < 0.15


@pytest.mark.parametrize(
    "changes",
    [
        {"wind": (0.0, 1.0, 0.0)},
        {"initial_wind": (0.0, -1.0, 0.0)},
        {"fps": 0.0},
        {"bending": -1.0},
        {"grid": (2, 8)},
        {"refinement": 0},
    ],
)
def test_bad_settings_are_refused(tiny_settings: GeneratorSettings, changes: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=next(iter(changes))):
        replace(tiny_settings, **changes)


def test_a_cloth_that_leaves_the_image_is_refused(
    tiny_settings: GeneratorSettings, tiny_texture: Tensor
) -> None:
    with pytest.raises(InputError, match="leaves the image"):
        generate(replace(tiny_settings, focal_length=500.0, n_frames=2), tiny_texture)


def test_needs_a_texture_and_a_matching_grid(tiny_settings: GeneratorSettings, tiny: Generated) -> None:
    with pytest.raises(InputError, match="texture"):
        generate(tiny_settings)
    scene, _ = tiny
    template = Template(
        name="scan",
        positions=scene.template,
        faces=grid_faces(8, 8),
        texture=scene.texture,
        texture_coordinates=scene.texture_coordinates,
        cloth_size=scene.cloth_size,
        camera=scene.camera,
        pinned_vertices=scene.pinned_vertices,
    )
    with pytest.raises(InputError, match="template"):
        generate(replace(tiny_settings, grid=(8, 9)), template=template)


def test_settings_are_plain_values(tiny_settings: GeneratorSettings) -> None:
    """A YAML file can mirror them: numbers, texts, tuples of numbers, and one motion object."""
    for f in fields(tiny_settings):
        value = getattr(tiny_settings, f.name)
        items = value if isinstance(value, tuple) else (value,)
        assert all(item is None or isinstance(item, (int, float, str, PinnedMotion)) for item in items), (
            f.name
        )
