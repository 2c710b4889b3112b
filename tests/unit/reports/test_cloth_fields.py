from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from toile.geometry.camera import Camera
from toile.reports.cloth_fields import (
    TURBULENCE,
    Upright,
    colour_residual,
    distance_to_points,
    error_field,
    force_field,
)
from toile.reports.page.charts import field_maps
from toile.reports.playback import playback
from toile.scenes.scene import GroundTruth


def grid(F: int = 2, H: int = 3, W: int = 4) -> np.ndarray:
    j, i = np.meshgrid(np.arange(W), np.arange(H))
    frame = np.stack((0.1 * j, 0.1 * i, np.ones((H, W))), -1)
    return np.stack([frame + np.array([0, 0, 0.01 * f]) for f in range(F)])


def test_distance_to_points_is_per_vertex() -> None:
    x = np.zeros((1, 2, 2, 3))
    x[0, 1, 1, 0] = 3.0
    assert distance_to_points(x, [np.array([[0.0, 4.0, 0.0]])])[0].tolist() == [[4.0, 4.0], [4.0, 5.0]]


def test_error_is_taken_to_the_true_vertex_not_the_nearest_one() -> None:
    x = grid()
    truth = x.copy()
    truth[..., 0] += 0.1  # every vertex stands where its neighbour should
    field = error_field(x, GroundTruth(vertices=torch.from_numpy(truth)))
    assert field is not None
    np.testing.assert_allclose(field.values, 100.0)
    cloud = GroundTruth(point_clouds=tuple(torch.from_numpy(f.reshape(-1, 3)) for f in truth))
    nearest = error_field(x, cloud)
    assert nearest is not None
    assert nearest.values[:, :, 1:].max() < 1e-9
    assert error_field(x, None) is None


def test_force_of_the_last_frame_is_unknown() -> None:
    turbulence = np.zeros((1, 3, 4, 3))
    turbulence[0, 1, 2] = (3.0, 0.0, 4.0)
    field = force_field({TURBULENCE: turbulence}, 2)
    assert field is not None
    assert field.values.shape == (2, 3, 4)
    assert field.values[0, 1, 2] == 5.0
    assert np.isnan(field.values[1]).all()
    assert force_field({TURBULENCE: np.zeros((1, 3, 4, 3))}, 2) is None
    assert force_field({}, 2) is None


def test_residual_only_where_a_vertex_is_seen() -> None:
    observed, rendered = torch.full((20, 20, 3), 0.5), torch.full((20, 20, 3), 0.3)
    positions = torch.tensor([[[0.0, 0.0, 1.0], [0.1, 0.0, 1.0]]])
    camera = Camera(10, 10, 10, 10, 20, 20)
    seen = torch.tensor([[True, False]])
    values = colour_residual(observed, torch.ones(20, 20), rendered, positions, seen, camera)
    assert values[0, 0] == pytest.approx(0.2, abs=1e-6)
    assert math.isnan(values[0, 1])


@pytest.mark.parametrize("turn", [0, 1, 2, 3])
def test_maps_lie_as_the_cloth_does_in_the_image(turn: int) -> None:
    """However the grid is numbered, image rows come out from top to bottom, columns from left to right."""
    x = grid(1)[0]
    expected_x, expected_y = x[..., 0], x[..., 1]
    turned = np.rot90(x, turn)
    for candidate in (turned, turned[::-1]):
        upright = Upright.of(candidate)
        np.testing.assert_array_equal(upright(candidate[..., 0]), expected_x)
        np.testing.assert_array_equal(upright(candidate[..., 1]), expected_y)


def test_maps_show_mean_frame_and_rows_over_time() -> None:
    x = grid(3)
    field = error_field(x, GroundTruth(vertices=torch.from_numpy(np.zeros_like(x))))
    assert field is not None
    pinned = np.zeros((3, 4), dtype=bool)
    pinned[0, 3] = True
    figure = field_maps(field, Upright.of(x[0]), pinned)
    mean, frame, rows = (np.array(figure.data[k].z) for k in range(3))
    np.testing.assert_allclose(mean, field.values.mean(0), rtol=1e-6)
    np.testing.assert_allclose(frame, field.values[1], rtol=1e-6)
    np.testing.assert_allclose(rows, field.values.mean(2).T, rtol=1e-6)
    assert (list(figure.data[3].x), list(figure.data[3].y)) == ([3], [0])


def test_view_in_3d_holds_the_whole_motion_in_fixed_axes() -> None:
    x = grid(5)
    scene = playback(x, None, [np.array([[2.0, -1.0, 3.0]])]).layout.scene
    for axis, (low, high) in zip("xyz", ((0, 2.0), (1.0, 3.0), (-0.2, 1.0)), strict=True):
        start, end = scene[f"{axis}axis"].range
        assert start < low
        assert end > high
