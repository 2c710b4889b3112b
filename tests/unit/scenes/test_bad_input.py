"""Every kind of bad input gives one InputError that says what, where, expected and got."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from toile.errors import InputError
from toile.geometry.io import read_mesh, write_mesh
from toile.scenes.doctor import diagnose, diagnose_folder
from toile.scenes.findings import Severity
from toile.scenes.images import write_image
from toile.scenes.native import load_native
from toile.scenes.scene import Scene
from toile.scenes.validation import check_scene

Breaker = Callable[[Path], None]


def change(**values: Any) -> Breaker:
    def apply(folder: Path) -> None:
        path = folder / "scene.json"
        description = json.loads(path.read_text())
        for key, value in values.items():
            if value is None:
                del description[key]
            else:
                description[key] = value
        path.write_text(json.dumps(description))

    return apply


def edit_intrinsics(edit: Callable[[list[list[float]]], None]) -> Breaker:
    def apply(folder: Path) -> None:
        K = json.loads((folder / "scene.json").read_text())["K"]
        edit(K)
        change(K=K)(folder)

    return apply


def swap_principal_point(K: list[list[float]]) -> None:
    K[0][2], K[1][2] = K[1][2], K[0][2]


def set_entry(row: int, column: int, value: float) -> Breaker:
    return edit_intrinsics(lambda K: K[row].__setitem__(column, value))


def edit_template(edit: Callable[[torch.Tensor], torch.Tensor]) -> Breaker:
    """Edit positions (6, 5, 3) of the OBJ; faces and texture coordinates stay."""

    def apply(folder: Path) -> None:
        mesh = read_mesh(folder / "template.obj")
        positions = edit(mesh.vertices.reshape(6, 5, 3).clone()).reshape(-1, 3)
        write_mesh(folder / "template.obj", positions, mesh.polygons, mesh.texture_coordinates)

    return apply


def set_nan(positions: torch.Tensor) -> torch.Tensor:
    positions[2, 3, 1] = torch.nan
    return positions


def swap_two(positions: torch.Tensor) -> torch.Tensor:
    positions[1, 1], positions[4, 3] = positions[4, 3].clone(), positions[1, 1].clone()
    return positions


def shuffle(positions: torch.Tensor) -> torch.Tensor:
    order = torch.randperm(30, generator=torch.Generator().manual_seed(0))
    return positions.reshape(-1, 3)[order].reshape(6, 5, 3)


def shuffle_with_faces(folder: Path) -> None:
    """A permuted vertex order whose faces follow, as an exporter that reorders would write it."""
    mesh = read_mesh(folder / "template.obj")
    order = torch.randperm(30, generator=torch.Generator().manual_seed(0))
    new = {int(old): k for k, old in enumerate(order)}
    faces = [[new[k] for k in face] for face in mesh.polygons]
    assert mesh.texture_coordinates is not None
    write_mesh(folder / "template.obj", mesh.vertices[order], faces, mesh.texture_coordinates[order])


def edit_faces(edit: Callable[[list[tuple[int, ...]]], list[tuple[int, ...]]]) -> Breaker:
    def apply(folder: Path) -> None:
        mesh = read_mesh(folder / "template.obj")
        faces = edit(list(mesh.polygons))
        write_mesh(folder / "template.obj", mesh.vertices, faces, mesh.texture_coordinates)

    return apply


def drop_texture_coordinates(folder: Path) -> None:
    mesh = read_mesh(folder / "template.obj")
    write_mesh(folder / "template.obj", mesh.vertices, mesh.polygons)


def texture_upwards(folder: Path) -> None:
    mesh = read_mesh(folder / "template.obj")
    assert mesh.texture_coordinates is not None
    up = torch.stack((mesh.texture_coordinates[:, 0], 1 - mesh.texture_coordinates[:, 1]), -1)
    write_mesh(folder / "template.obj", mesh.vertices, mesh.polygons, up)


def remove(name: str) -> Breaker:
    return lambda folder: (folder / name).unlink()


def overwrite(name: str, text: str) -> Breaker:
    def apply(folder: Path) -> None:
        (folder / name).write_text(text)

    return apply


def truncate(name: str) -> Breaker:
    return lambda folder: (folder / name).write_bytes((folder / name).read_bytes()[:300]) and None


def image(name: str, *shape: int) -> Breaker:
    return lambda folder: write_image(folder / name, torch.zeros(shape))


def truth_nan(folder: Path) -> None:
    path = folder / "ground_truth" / "vertices.npy"
    vertices = np.load(path)
    vertices[2, 0, 0, 0] = np.inf
    np.save(path, vertices)


def flipped_texture(folder: Path) -> None:
    from PIL import Image, ImageOps

    with Image.open(folder / "texture.png") as picture:
        flipped = ImageOps.flip(picture)
    flipped.save(folder / "texture.png")


CASES: dict[str, tuple[Breaker, tuple[str, ...]]] = {
    "no scene.json": (remove("scene.json"), ("scene.json is missing", "template.obj, texture.png")),
    "invalid JSON": (overwrite("scene.json", '{"fps": 25,'), ("no valid JSON", "line 1")),
    "JSON list": (overwrite("scene.json", "[]"), ("no valid JSON", "a list at the top level")),
    "missing key": (change(fps=None), ("'fps' is missing", "keys id, n_frames")),
    "text for a number": (change(fps="fast"), ("'fps'", "frames per second", "fast")),
    "fps zero": (change(fps=0), ("Frame rate", "fps > 0", "0")),
    "fps negative": (change(fps=-25.0), ("Frame rate", "fps > 0", "-25")),
    "units": (change(units="millimetres"), ("'units'", "metres", "millimetres")),
    "gravity of two": (change(gravity=[0, 9.81]), ("'gravity'", "m/s²", "[0, 9.81]")),
    "cloth size negative": (change(cloth_size_m=[0.5, -0.4]), ("'cloth_size_m'", "positive", "-0.4")),
    "held out of range": (
        change(pinned_vertices=None, held_vertices=[0, 30]),
        ("Pinned vertex", "0 to 29", "30"),
    ),
    "pinned negative": (change(pinned_vertices=[-1]), ("Pinned vertex", "0 to 29", "-1")),
    "held twice": (change(pinned_vertices=[0, 25, 0]), ("listed twice", "distinct", "0 more than once")),
    "focal zero": (set_entry(0, 0, 0.0), ("Focal length", "fx > 0", "fx 0")),
    "focal negative": (set_entry(1, 1, -105.0), ("Focal length", "fy > 0", "fy -105")),
    "NaN in K": (set_entry(0, 2, float("nan")), ("'K'", "finite", "nan")),
    "infinite K": (set_entry(1, 1, float("inf")), ("'K'", "finite", "inf")),
    "K transposed": (
        edit_intrinsics(lambda K: K.__setitem__(slice(None), [list(r) for r in zip(*K, strict=True)])),
        ("'K'", "transposed"),
    ),
    "principal point swapped": (
        edit_intrinsics(swap_principal_point),
        ("does not project onto mask 0", "cx and cy are exchanged", "with that undone"),
    ),
    "principal point outside": (
        change(K=[[110, 0, 38.25], [0, 105, 95.0], [0, 0, 1]]),
        ("Principal point is outside", "exchanged", "cy <= 80", "cy 95"),
    ),
    "image size swapped": (change(image_size=[120, 80]), ("height and width are exchanged", "80 x 120")),
    "frame missing": (remove("rgbs/rgb_002.png"), ("rgb_002.png is missing", "3 files there")),
    "mask missing": (remove("masks/mask_003.png"), ("mask_003.png is missing", "3 files there")),
    "mask of another size": (image("masks/mask_001.png", 40, 60), ("mask_001.png", "80 x 120", "40 x 60")),
    "truncated frame": (
        truncate("rgbs/rgb_001.png"),
        ("rgb_001.png is unreadable or truncated", "300 bytes"),
    ),
    "unreadable mask": (overwrite("masks/mask_002.png", "no"), ("mask_002.png is unreadable", "2 bytes")),
    "empty mask": (image("masks/mask_002.png", 80, 120), ("mask_002.png is empty", "zeros everywhere")),
    "no texture": (remove("texture.png"), ("texture.png is missing",)),
    "texture upside down": (flipped_texture, ("Texture is upside down", "row 0 on top")),
    "no template": (remove("template.obj"), ("template.obj is missing", "scene.json")),
    "broken OBJ": (overwrite("template.obj", "v 0 0 1\nv 1 zwei 3\n"), ("line 2", "'v x y z'", "zwei")),
    "grid mismatch": (
        change(grid=[5, 5]),
        ("not the declared grid", "5 x 5 = 25 vertices", "30 vertices and 20 faces"),
    ),
    "grid transposed": (change(grid=[5, 6]), ("not grid quads", "5 x 6")),
    "a face missing": (
        edit_faces(lambda faces: faces[:-1]),
        ("do not cover the grid once", "20 quads", "19 faces", "(4, 3)"),
    ),
    "a foreign face": (edit_faces(lambda f: [*f[:-1], (0, 7, 14, 21)]), ("not grid quads", "(0, 7, 14, 21)")),
    "order shuffled": (edit_template(shuffle), ("Vertex order", "permuted", "edges near 0.1 m")),
    "two vertices swapped": (
        edit_template(swap_two),
        ("Vertex order", "permuted", "between vertices"),
    ),
    "order and faces shuffled": (shuffle_with_faces, ("not grid quads", "permuted", "zero-based")),
    "column-major order": (
        edit_template(lambda p: p.transpose(0, 1).reshape(6, 5, 3)),
        ("Vertex order", "transposed (column-major)"),
    ),
    "NaN in template": (edit_template(set_nan), ("NaN or infinite", "vertex 13", "finite")),
    "millimetres": (edit_template(lambda p: p * 1000), ("millimetres", "nearer than 50 m", "120")),
    "centimetre cloth": (
        edit_template(lambda p: p * 30),
        ("millimetres or centimetres", "edges of 30 and 30 times"),
    ),
    "wrong cloth size": (change(cloth_size_m=[0.8, 0.64]), ("cloth size disagree", "0.16 m", "0.625")),
    "behind the camera": (
        edit_template(lambda p: p * torch.tensor([1.0, 1.0, -1.0])),
        ("behind the camera", "z > 0", "30 of 30"),
    ),
    "y flipped": (
        edit_template(lambda p: p * torch.tensor([1.0, -1.0, 1.0])),
        ("does not project onto mask 0", "flipped in y"),
    ),
    "x mirrored": (
        edit_template(lambda p: p * torch.tensor([-1.0, 1.0, 1.0])),
        ("does not project onto mask 0", "mirrored in x"),
    ),
    "rotated by half a turn": (
        edit_template(lambda p: p * torch.tensor([-1.0, -1.0, 1.0])),
        ("does not project onto mask 0", "x and y are negated"),
    ),
    "no texture coordinates": (drop_texture_coordinates, ("no texture coordinates", "(u, v) per vertex")),
    "v upwards": (texture_upwards, ("v measured upwards", "v down", "with 1 - v")),
    "NaN in ground truth": (truth_nan, ("Ground truth has NaN", "frame 2")),
    "ground truth of another grid": (
        lambda f: np.save(f / "ground_truth" / "vertices.npy", np.zeros((4, 5, 6, 3))),
        ("Ground-truth vertices have the wrong shape", "6, 5, 3", "(4, 5, 6, 3)"),
    ),
    "point cloud missing": (
        remove("ground_truth/point_cloud_001.npy"),
        ("point_cloud_001.npy is missing", "0 to 3", "3 files"),
    ),
    "too few point clouds": (
        remove("ground_truth/point_cloud_003.npy"),
        ("do not match the frames", "4 clouds", "3"),
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_loader_says_what_where_expected_and_got(tiny_folder: Path, case: str) -> None:
    breaker, expected = CASES[case]
    breaker(tiny_folder)
    with pytest.raises(InputError) as caught:
        load_native(tiny_folder)
    error = caught.value
    assert all((error.what, error.where, error.expected, error.got))
    assert str(tiny_folder) in error.where
    for text in expected:
        assert text in str(error)


@pytest.mark.parametrize("case", CASES)
def test_doctor_finds_it_as_well(tiny_folder: Path, case: str) -> None:
    breaker, expected = CASES[case]
    breaker(tiny_folder)
    errors = [f for f in diagnose_folder(tiny_folder) if f.severity is Severity.ERROR]
    assert any(all(text in str(f.to_error()) for text in expected) for f in errors)


def test_doctor_collects_many_at_once_with_errors_first(tiny_folder: Path) -> None:
    change(gravity=[0.0, 1.62, 0.0], pinned_vertices=[99], fps=-1)(tiny_folder)
    remove("rgbs/rgb_001.png")(tiny_folder)
    truncate("rgbs/rgb_003.png")(tiny_folder)
    image("masks/mask_002.png", 80, 120)(tiny_folder)
    edit_template(set_nan)(tiny_folder)
    findings = diagnose_folder(tiny_folder)
    text = "\n".join(map(str, findings))
    for part in ("Pinned vertex", "Frame rate", "rgb_001.png", "rgb_003.png", "mask_002.png", "NaN"):
        assert part in text
    ranks = [("error", "warning", "info").index(f.severity) for f in findings]
    assert ranks == sorted(ranks)


def test_doctor_of_a_good_scene_has_nothing_but_information(tiny_folder: Path) -> None:
    findings = diagnose_folder(tiny_folder)
    assert findings
    assert [f.what for f in findings if f.severity is not Severity.INFO] == ["Few frames"]
    assert any("Edge lengths" in f.what for f in findings)


def test_missing_folder_lists_its_neighbours(tiny_folder: Path) -> None:
    with pytest.raises(InputError, match=r"(?s)folder is missing.*tiny"):
        load_native(tiny_folder.parent / "tinny")
    assert diagnose_folder(tiny_folder.parent / "tinny")[0].severity is Severity.ERROR
    assert "not found" in diagnose("tinny", tiny_folder.parent)[0].what


def warnings_of(scene: Scene) -> str:
    return "\n".join(str(f) for f in check_scene(scene) if f.severity is Severity.WARNING)


def infos_of(scene: Scene) -> str:
    return "\n".join(str(f) for f in check_scene(scene) if f.severity is Severity.INFO)


def with_gravity(scene: Scene, *gravity: float) -> Scene:
    return replace(scene, gravity=torch.tensor(gravity, dtype=torch.float64))


def test_unusual_gravity_is_a_warning_with_the_number(tiny_scene: Scene) -> None:
    assert "1.62" in warnings_of(with_gravity(tiny_scene, 0, 1.62, 0))
    assert "unusual magnitude" in warnings_of(with_gravity(tiny_scene, 0, 0, 0))


def test_gravity_beside_the_hanging_direction(tiny_scene: Scene) -> None:
    assert "direction in which" not in infos_of(with_gravity(tiny_scene, 0, 9.81, 0))
    assert "degrees" in infos_of(with_gravity(tiny_scene, 3.36, 9.22, 0))
    assert "degrees" in warnings_of(with_gravity(tiny_scene, 0, -9.81, 0))


def test_held_at_the_lower_side_hints_at_the_vertex_order(tiny_scene: Scene) -> None:
    assert "reversed along axis 1" in warnings_of(replace(tiny_scene, pinned_vertices=(4, 29)))
    assert "vertex order" not in warnings_of(tiny_scene)


def test_transposed_square_grid_is_given_away_by_the_pinned_corners(tiny_scene: Scene) -> None:
    square = tiny_scene.template[:5]
    scene = replace(
        tiny_scene,
        template=square.transpose(0, 1),
        texture_coordinates=tiny_scene.texture_coordinates[:5].transpose(0, 1),
        cloth_size=(0.4, 0.4),
        pinned_vertices=(0, 20),
        ground_truth=None,
    )
    assert "transposed" in warnings_of(scene)


def test_exchanged_cloth_sizes_are_an_error(tiny_folder: Path) -> None:
    edit_template(lambda p: p * torch.tensor([1.0, 1.6, 1.0]))(tiny_folder)
    change(cloth_size_m=[0.64, 0.5])(tiny_folder)
    with pytest.raises(InputError, match=r"transposed, or the two cloth sizes are exchanged"):
        load_native(tiny_folder)


def test_ground_truth_away_from_the_template_is_a_warning(tiny_folder: Path) -> None:
    path = tiny_folder / "ground_truth" / "vertices.npy"
    np.save(path, np.load(path) + 0.05)
    assert any("8.66 cm" in note for note in load_native(tiny_folder).notes)
