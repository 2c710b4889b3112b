from __future__ import annotations

import dataclasses
import io

import imageio.v3 as iio
import numpy as np
import pytest

from toile.errors import InputError
from toile.export.animation import ClothAnimation
from toile.export.formats import FORMATS, export_animation
from toile.geometry.mesh import grid_faces


def test_y_up_is_half_a_turn_about_x(animation: ClothAnimation) -> None:
    x = animation.positions.reshape(3, 12, 3)
    assert np.array_equal(animation.vertices(keep_camera_frame=True), x)
    assert np.allclose(animation.vertices(), x * [1, -1, -1])


def test_quads_split_into_the_triangles_of_the_grid(animation: ClothAnimation) -> None:
    a, b, c, d = animation.quads().T
    split = np.stack((np.stack((a, b, c), -1), np.stack((a, c, d), -1)), 1).reshape(-1, 3)
    assert np.array_equal(split, grid_faces(3, 4).numpy())
    assert np.array_equal(animation.triangles(), split)


def test_texture_coordinates_flip_only_v(animation: ClothAnimation) -> None:
    down, up = animation.uv(v_up=False), animation.uv(v_up=True)
    assert down is not None
    assert up is not None
    assert np.allclose(down * [1, -1] + [0, 1], up)


def test_texture_keeps_row_zero_on_top(animation: ClothAnimation) -> None:
    png = animation.png()
    assert png is not None
    assert animation.texture is not None
    assert np.array_equal(iio.imread(io.BytesIO(png)), np.round(animation.texture * 255).astype(np.uint8))


@pytest.mark.parametrize(
    "change",
    [
        {"positions": np.zeros((3, 12, 3))},
        {"positions": np.full((1, 2, 2, 3), np.nan)},
        {"fps": 0.0},
        {"texture_coordinates": np.zeros((2, 2, 2))},
        {"texture": np.zeros((4, 4, 3)), "texture_coordinates": None},
    ],
    ids=["flat", "nan", "fps", "uv", "texture without uv"],
)
def test_bad_animations_are_refused(change: dict[str, object]) -> None:
    arguments: dict[str, object] = {"positions": np.zeros((1, 3, 3, 3)), "fps": 25.0}
    with pytest.raises(InputError, match="exported"):
        ClothAnimation(**(arguments | change))  # type: ignore[arg-type]


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_writes_the_files_it_names(name: str, animation: ClothAnimation, tmp_path) -> None:
    paths = export_animation(animation, tmp_path, name)
    assert len(paths) == (3 if name in ("obj", "ply") else 1)
    assert all(p.stat().st_size > 0 for p in paths)


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_takes_a_single_frame_without_texture(name: str, tmp_path) -> None:
    bare = ClothAnimation(positions=np.random.default_rng(0).normal(size=(1, 2, 2, 3)), fps=30.0)
    export_animation(bare, tmp_path, name)
    assert not list(tmp_path.rglob("*.png"))


def test_unknown_format_lists_the_known_ones(animation: ClothAnimation, tmp_path) -> None:
    with pytest.raises(InputError, match="obj, ply, glb, usd"):
        export_animation(animation, tmp_path, "abc")


@pytest.mark.parametrize("times", [[0.0, 0.1], [0.0, 0.2, 0.1]])
def test_times_that_fit_no_frames(animation: ClothAnimation, times: list[float]) -> None:
    with pytest.raises(InputError, match="cannot be exported"):
        dataclasses.replace(animation, times=np.array(times))
