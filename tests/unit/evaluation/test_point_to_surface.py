from __future__ import annotations

import pytest
import torch

from toile.evaluation.point_to_surface import closest_points, point_to_surface
from toile.geometry.mesh import grid_faces

FACES = grid_faces(2, 2)
SQUARE = torch.tensor([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], dtype=torch.float64)


def test_distance_above_beside_and_at_a_corner() -> None:
    points = torch.tensor([[0.3, 0.2, 0.5], [1.25, 0.5, 0.0], [-3.0, -4.0, 0.0], [0.5, 0.5, 0.0]])
    closest = closest_points(points, SQUARE, FACES)
    assert closest.distance.tolist() == pytest.approx([0.5, 0.25, 5.0, 0.0])
    assert closest.point[0].tolist() == pytest.approx([0.3, 0.2, 0.0], abs=1e-6)
    assert point_to_surface(points, SQUARE, FACES) == pytest.approx((0.5 + 0.25 + 5.0) / 4)


def test_has_no_sampling_floor() -> None:
    points = torch.rand(500, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    points[:, 2] = 0
    assert point_to_surface(points, SQUARE, FACES) == pytest.approx(0.0, abs=1e-12)
