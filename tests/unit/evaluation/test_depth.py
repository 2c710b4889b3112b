from __future__ import annotations

import math

import pytest
import torch

from toile.evaluation.depth import depth_error, depth_map_error
from toile.geometry.camera import Camera

CAMERA = Camera(10.0, 10.0, 4.0, 4.0, 8, 8)


def test_error_is_the_depth_offset_and_uncovered_points_do_not_count() -> None:
    depth = torch.zeros(8, 8)
    depth[:, 4:] = 1.02
    silhouette = (depth > 0).float()
    points = torch.tensor([[0.05, 0.05, 1.0], [0.15, -0.15, 1.0], [-0.15, 0.05, 1.0], [5.0, 0.0, 1.0]])
    error = depth_error(points, depth, silhouette, CAMERA)
    assert error.mean == pytest.approx(0.02, abs=1e-6)
    assert error.coverage == pytest.approx(2 / 3)


def test_row_and_column_are_not_swapped() -> None:
    depth = torch.zeros(8, 8)
    depth[1, 6] = 2.0
    points = torch.tensor([[2.5 / 10 * 2, -2.5 / 10 * 2, 2.0]])  # pixel x = 6.5, y = 1.5
    assert depth_error(points, depth, (depth > 0).float(), CAMERA).mean == pytest.approx(0.0, abs=1e-7)


def test_half_covered_border_pixels_and_background_are_left_out() -> None:
    depth = torch.full((8, 8), 3.0)
    silhouette = torch.full((8, 8), 0.5)
    error = depth_error(torch.tensor([[0.0, 0.0, 1.0]]), depth, silhouette, CAMERA)
    assert math.isnan(error.mean)
    assert error.coverage == 0.0


def test_points_behind_the_camera_or_outside_give_nan() -> None:
    error = depth_error(torch.tensor([[0.0, 0.0, -1.0]]), torch.ones(8, 8), torch.ones(8, 8), CAMERA)
    assert math.isnan(error.mean)
    assert math.isnan(error.coverage)


def test_depth_maps_compare_where_both_are_covered() -> None:
    a, b = torch.zeros(4, 4), torch.zeros(4, 4)
    a[:, :3], b[:, 1:] = 1.5, 1.0
    error = depth_map_error(a, (a > 0).float(), b, (b > 0).float())
    assert error.mean == pytest.approx(0.5)
    assert error.coverage == pytest.approx(2 / 3)
