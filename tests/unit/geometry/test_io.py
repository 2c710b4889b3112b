from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from toile.errors import InputError
from toile.geometry.io import read_mesh, read_point_cloud, write_mesh, write_point_cloud


def test_obj_keeps_order_quads_and_every_digit(tmp_path: Path) -> None:
    vertices = torch.rand(6, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) / 3
    uv = torch.rand(6, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    faces = [(5, 4, 1, 2), (0, 1, 4, 3)]
    write_mesh(tmp_path / "m.obj", vertices, faces, uv)
    mesh = read_mesh(tmp_path / "m.obj")
    assert torch.equal(mesh.vertices, vertices)
    assert mesh.polygons == tuple(faces)
    assert mesh.texture_coordinates is not None
    assert torch.equal(mesh.texture_coordinates, uv)
    assert mesh.seam_vertices == ()


def test_obj_with_texture_indices_of_their_own(tmp_path: Path) -> None:
    (tmp_path / "m.obj").write_text(
        "# comment\nmtllib x.mtl\no name\n"
        "v 0 0 1\nv 1 0 1 0.5 0.5 0.5\nv 1 1 1\nv 0 1 1\n"
        "vn 0 0 1\nvt 0.1 0.9\nvt 0.2 0.8\nvt 0.3 0.7\nvt 0.4 0.6\n"
        "s off\nf 3/1/1 4/2/1 \\\n 1/3/1 2/4/1\n"
    )
    mesh = read_mesh(tmp_path / "m.obj")
    assert mesh.polygons == ((2, 3, 0, 1),)
    assert mesh.texture_coordinates is not None
    assert mesh.texture_coordinates.tolist() == [[0.3, 0.7], [0.4, 0.6], [0.1, 0.9], [0.2, 0.8]]


def test_obj_negative_indices_and_normals_without_texture(tmp_path: Path) -> None:
    (tmp_path / "m.obj").write_text("v 0 0 1\nv 1 0 1\nv 1 1 1\nvn 0 0 1\nf -3//1 -2//1 -1//1\n")
    mesh = read_mesh(tmp_path / "m.obj")
    assert mesh.polygons == ((0, 1, 2),)
    assert mesh.texture_coordinates is None


def test_obj_seams_are_reported_and_missing_coordinates_are_nan(tmp_path: Path) -> None:
    (tmp_path / "m.obj").write_text(
        "v 0 0 1\nv 1 0 1\nv 1 1 1\nv 0 1 1\nv 2 2 2\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0.5 0.5\n"
        "f 1/1 2/2 3/3\nf 1/4 3/3 4/2\n"
    )
    mesh = read_mesh(tmp_path / "m.obj")
    assert mesh.seam_vertices == (0,)
    assert mesh.texture_coordinates is not None
    assert mesh.texture_coordinates[0].tolist() == [0.0, 0.0]
    assert bool(mesh.texture_coordinates[4].isnan().all())


@pytest.mark.parametrize(
    ("text", "line", "got"),
    [
        ("v 0 0\n", "line 1", "2 numbers"),
        ("v 0 0 1\nf 1 2 3\n", "line 2", "index 2 with 1 items"),
        ("v 0 0 1\nf 0 1 1\n", "line 2", "index 0"),
        ("v 0 0 1\nv 0 0 1\nf 1 2\n", "line 3", "2 corners"),
        ("v 0 0 1\n# fine\nv a b c\n", "line 3", "'a'"),
    ],
)
def test_bad_obj_lines_are_named(tmp_path: Path, text: str, line: str, got: str) -> None:
    (tmp_path / "m.obj").write_text(text)
    with pytest.raises(InputError) as caught:
        read_mesh(tmp_path / "m.obj")
    assert line in caught.value.where
    assert got in caught.value.got


def test_empty_and_missing_mesh(tmp_path: Path) -> None:
    (tmp_path / "m.obj").write_text("# nothing\n")
    with pytest.raises(InputError, match="Mesh is empty"):
        read_mesh(tmp_path / "m.obj")
    with pytest.raises(InputError, match=r"(?s)n\.obj is missing.*holds m\.obj"):
        read_mesh(tmp_path / "n.obj")
    with pytest.raises(InputError, match="no such folder"):
        read_mesh(tmp_path / "no" / "n.obj")


def test_ply_through_trimesh_keeps_order_and_duplicates(tmp_path: Path) -> None:
    vertices = torch.tensor([[2.0, 0, 1], [0, 0, 1], [0, 1, 1], [0, 0, 1], [5, 5, 5]])
    write_mesh(tmp_path / "m.ply", vertices, [(0, 1, 2), (2, 3, 0)])
    mesh = read_mesh(tmp_path / "m.ply")
    assert torch.equal(mesh.vertices, vertices.double())
    assert mesh.polygons == ((0, 1, 2), (2, 3, 0))
    with pytest.raises(InputError, match="4 corners"):
        write_mesh(tmp_path / "q.ply", vertices, [(0, 1, 2, 4)])


def test_unreadable_mesh(tmp_path: Path) -> None:
    (tmp_path / "m.ply").write_text("no mesh at all")
    with pytest.raises(InputError, match="cannot be read"):
        read_mesh(tmp_path / "m.ply")


@pytest.mark.parametrize("suffix", [".pt", ".npy", ".ply", ".xyz"])
def test_point_clouds_keep_their_order(tmp_path: Path, suffix: str) -> None:
    points = torch.rand(50, 3, generator=torch.Generator().manual_seed(2))
    write_point_cloud(tmp_path / f"c{suffix}", points)
    read = read_point_cloud(tmp_path / f"c{suffix}")
    assert read.dtype == torch.float32
    assert torch.allclose(read, points, atol=1e-6)


def test_point_cloud_errors(tmp_path: Path) -> None:
    np.save(tmp_path / "flat.npy", np.zeros(9))
    with pytest.raises(InputError, match=r"(?s)wrong shape.*\(N, 3\).*\(9,\)"):
        read_point_cloud(tmp_path / "flat.npy")
    (tmp_path / "bad.pt").write_bytes(b"xx")
    with pytest.raises(InputError, match="cannot be read"):
        read_point_cloud(tmp_path / "bad.pt")
    torch.save({"a": 1}, tmp_path / "dict.pt")
    with pytest.raises(InputError, match=r"got: +dict"):
        read_point_cloud(tmp_path / "dict.pt")
    with pytest.raises(InputError, match="is missing"):
        read_point_cloud(tmp_path / "none.ply")


def test_point_cloud_files_cannot_run_code(tmp_path: Path) -> None:
    np.save(tmp_path / "object.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(InputError, match="cannot be read"):
        read_point_cloud(tmp_path / "object.npy")
