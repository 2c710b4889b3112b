from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from toile.evaluation.normals import cloud_normal_error, cloud_normals, vertex_normal_error
from toile.geometry.mesh import grid_faces, sample_surface

FACES = grid_faces(6, 6)


def plane() -> Tensor:
    y, x = torch.meshgrid(
        torch.linspace(-1, 1, 6, dtype=torch.float64),
        torch.linspace(-1, 1, 6, dtype=torch.float64),
        indexing="ij",
    )
    return torch.stack((x, y, torch.zeros_like(x)), -1).reshape(-1, 3)


def about_x(points: Tensor, degrees: float) -> Tensor:
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return points @ torch.tensor([[1, 0, 0], [0, c, -s], [0, s, c]], dtype=torch.float64).T


@pytest.mark.parametrize("degrees", [0.0, 1e-4, 10.0, 90.0, 150.0, 180.0])
def test_vertex_normals_differ_by_the_rotation(degrees: float) -> None:
    error = vertex_normal_error(about_x(plane(), degrees), plane(), FACES)
    assert error.shape == (36,)
    torch.testing.assert_close(error, torch.full_like(error, degrees), atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize(("degrees", "expected"), [(0.0, 0.0), (20.0, 20.0), (90.0, 90.0), (170.0, 10.0)])
def test_cloud_normals_differ_by_the_unoriented_rotation(degrees: float, expected: float) -> None:
    cloud = sample_surface(about_x(plane(), degrees), FACES, 3000, torch.Generator().manual_seed(0))
    error = cloud_normal_error(plane(), FACES, cloud, seed=0, samples=200, neighbours=20)
    assert error == pytest.approx(expected, abs=1e-4)


def test_pca_averages_noise() -> None:
    generator = torch.Generator().manual_seed(0)
    cloud = sample_surface(plane(), FACES, 5000, generator)
    cloud[:, 2] += 0.002 * torch.randn(5000, generator=generator, dtype=torch.float64)
    normals = cloud_normals(cloud, cloud[:100], neighbours=50)
    assert normals.shape == (100, 3)
    assert (abs(normals[:, 2]) > math.cos(math.radians(3))).all()
