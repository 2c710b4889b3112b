from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh

from toile.export.animation import ClothAnimation
from toile.export.obj import export_obj
from toile.export.ply import export_ply


def columns(path: Path, key: str) -> np.ndarray:
    rows = [line.split()[1:] for line in path.read_text().splitlines() if line.startswith(key + " ")]
    return np.array(rows)


@pytest.mark.parametrize("keep", [False, True])
def test_obj_keeps_vertices_order_quads_and_texture(
    animation: ClothAnimation, tmp_path: Path, keep: bool
) -> None:
    paths = export_obj(animation, tmp_path, keep_camera_frame=keep)
    assert [p.name for p in paths] == ["frame_0000.obj", "frame_0001.obj", "frame_0002.obj"]
    for f, path in enumerate(paths):
        read = columns(path, "v").astype(float)
        np.testing.assert_allclose(read, animation.vertices(keep)[f], rtol=1e-8)
    faces = columns(paths[1], "f")
    assert faces.shape == (6, 4)
    assert all(a == b for a, b in (corner.split("/") for corner in faces.ravel()))
    index = np.array([[int(c.split("/")[0]) for c in row] for row in faces])
    assert np.array_equal(index - 1, animation.quads())
    np.testing.assert_allclose(columns(paths[0], "vt").astype(float), animation.uv(v_up=True), rtol=1e-8)
    text = paths[0].read_text()
    assert "mtllib cloth.mtl" in text
    assert "map_Kd texture.png" in (tmp_path / "cloth.mtl").read_text()
    assert (tmp_path / "texture.png").read_bytes() == animation.png()


def test_obj_opens_elsewhere_with_its_texture(animation: ClothAnimation, tmp_path: Path) -> None:
    mesh = trimesh.load(export_obj(animation, tmp_path)[2], process=False)
    assert isinstance(mesh, trimesh.Trimesh)
    # This reader sorts vertices; every vertex must still be there with its own texture coordinates.
    read = np.hstack((mesh.vertices, mesh.visual.uv))
    expected = np.hstack((animation.vertices()[2], animation.uv(v_up=True)))
    by_x = [rows[np.argsort(rows[:, 0])] for rows in (read, expected)]
    np.testing.assert_allclose(*by_x, rtol=1e-8, atol=1e-12)
    assert mesh.visual.material.image.size == (6, 5)


@pytest.mark.parametrize("keep", [False, True])
def test_ply_keeps_vertices_order_and_quads_exactly(
    animation: ClothAnimation, tmp_path: Path, keep: bool
) -> None:
    paths = export_ply(animation, tmp_path, keep_camera_frame=keep)
    assert [p.name for p in paths] == ["frame_0000.ply", "frame_0001.ply", "frame_0002.ply"]
    for f, path in enumerate(paths):
        mesh = trimesh.load(path, process=False, maintain_order=True)
        assert isinstance(mesh, trimesh.Trimesh)
        assert np.array_equal(mesh.vertices, animation.vertices(keep)[f])
        # A reader may cut a quad along either diagonal; area and corner set tell quads from anything else.
        assert len(mesh.faces) == 2 * len(animation.quads())
        pairs = np.sort(np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]))
        q = animation.quads()
        sides = np.sort(np.concatenate([q[:, [k, (k + 1) % 4]] for k in range(4)]))
        assert {tuple(s) for s in sides} <= {tuple(p) for p in pairs}
    header = paths[0].read_bytes().split(b"end_header\n")[0].decode()
    assert "element face 6" in header
    assert "property double s" in header


@pytest.mark.parametrize(("export", "kind"), [(export_obj, "obj"), (export_ply, "ply")])
def test_frames_of_a_longer_animation_do_not_stay(
    animation: ClothAnimation, tmp_path: Path, export: Callable[..., list[Path]], kind: str
) -> None:
    paths = export(animation, tmp_path)
    later = paths[-1].with_name(f"frame_{len(paths):04d}.{kind}")
    other = tmp_path / f"frame_of_mine.{kind}"
    for path in (later, other):
        path.write_text("earlier")
    assert export(animation, tmp_path) == paths
    assert all(path.is_file() for path in (*paths, other))
    assert not later.exists()
