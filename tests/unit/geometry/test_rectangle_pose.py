"""Pose of a rectangle from its corners."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from toile.geometry.rectangle_pose import rectangle_grid, rectangle_pose

K = np.array([[900.0, 0, 500], [0, 880, 300], [0, 0, 1]])


def seen(points: np.ndarray) -> np.ndarray:
    p = points @ K.T
    return p[:, :2] / p[:, 2:]


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (0.5, -0.3, 0.1), (-0.7, 0.4, -0.2)])
def test_pose_is_found(turn) -> None:
    size, where = (0.6, 0.4), np.array([0.1, -0.05, 1.1])
    true = rectangle_grid(size, (5, 4)) @ Rotation.from_rotvec(turn).as_matrix().T + where
    corners = seen(true[[0, -1, -1, 0], [0, 0, -1, -1]])
    rotation, translation, error = rectangle_pose(size, corners, K)
    np.testing.assert_allclose(rectangle_grid(size, (5, 4)) @ rotation.T + translation, true, atol=1e-5)
    assert error < 1e-3


def test_grid_has_the_size_and_starts_at_the_upper_left() -> None:
    grid = rectangle_grid((0.6, 0.4), (4, 3))
    np.testing.assert_allclose(grid[0, 0], [-0.3, -0.2, 0])
    np.testing.assert_allclose(grid[-1, 0], [0.3, -0.2, 0])
    np.testing.assert_allclose(grid[0, -1], [-0.3, 0.2, 0])


def test_corners_of_another_shape_leave_an_error() -> None:
    corners = np.array([[400.0, 200], [600, 200], [600, 600], [400, 600]])
    assert rectangle_pose((0.6, 0.3), corners, K)[2] > 20
