from __future__ import annotations

import pytest
import torch

from toile.errors import InputError
from toile.evaluation.chamfer import chamfer_distance, nearest_distances, sample_like
from toile.geometry.mesh import grid_faces

FACES = grid_faces(2, 2)


def square(z: float) -> torch.Tensor:
    return torch.tensor([[0, 0, z], [1, 0, z], [0, 1, z], [1, 1, z]], dtype=torch.float64)


def test_hand_computed_pairs() -> None:
    r = torch.tensor([[0.0, 0, 0], [1, 0, 0]])
    t = torch.tensor([[0.0, 0, 0], [0, 0, 2], [0, 3, 0], [1, 0, 0]])
    d = nearest_distances(r, t)
    assert d.to_target.tolist() == [0.0, 0.0]
    assert d.to_reconstruction.tolist() == [0.0, 2.0, 3.0, 0.0]
    assert d.squared_chamfer == pytest.approx((4 + 9) / 4)
    assert d.l1_chamfer == pytest.approx(0.5 * 5 / 4)


def test_identical_points_have_distance_zero() -> None:
    points = torch.rand(50, 3, generator=torch.Generator().manual_seed(1))
    d = nearest_distances(points, points)
    assert d.squared_chamfer == 0.0
    assert d.l1_chamfer == 0.0


def test_parallel_planes_are_two_d_squared_above_the_sampling_floor() -> None:
    # The in-plane nearest-neighbour distance of n Poisson points on an area A has mean square A / (pi n).
    n, d = 4000, 0.1
    cloud = sample_like(square(0.0), FACES, torch.zeros(n, 3), seed=99)
    floor = 2 / (torch.pi * n)
    assert chamfer_distance(square(0.0), FACES, cloud, seed=0) == pytest.approx(floor, rel=0.1)
    assert chamfer_distance(square(d), FACES, cloud, seed=0) == pytest.approx(2 * d**2 + floor, rel=1e-3)


def test_is_symmetric_in_its_arguments() -> None:
    generator = torch.Generator().manual_seed(2)
    a, b = torch.rand(30, 3, generator=generator), torch.rand(70, 3, generator=generator)
    assert nearest_distances(a, b).squared_chamfer == pytest.approx(nearest_distances(b, a).squared_chamfer)
    assert nearest_distances(a, b).l1_chamfer == pytest.approx(nearest_distances(b, a).l1_chamfer)


def test_seed_decides_and_global_generator_does_not() -> None:
    cloud = torch.rand(200, 3, generator=torch.Generator().manual_seed(3)).double()
    torch.manual_seed(0)
    first = chamfer_distance(square(0.0), FACES, cloud, seed=5)
    state = torch.get_rng_state()
    torch.manual_seed(123)
    assert chamfer_distance(square(0.0), FACES, cloud, seed=5) == first
    assert chamfer_distance(square(0.0), FACES, cloud, seed=6) != first
    torch.manual_seed(0)
    assert torch.equal(torch.get_rng_state(), state)


def test_samples_are_as_many_as_the_target_and_on_the_surface() -> None:
    samples = sample_like(square(0.5), FACES, torch.zeros(123, 3), seed=0)
    assert samples.shape == (123, 3)
    assert samples[:, 2].tolist() == pytest.approx([0.5] * 123)


@pytest.mark.parametrize(
    "bad",
    [torch.zeros(0, 3), torch.zeros(4, 2), torch.full((4, 3), float("nan"))],
    ids=["empty", "2d", "nan"],
)
def test_unusable_points_raise(bad: torch.Tensor) -> None:
    with pytest.raises(InputError, match="Chamfer"):
        nearest_distances(torch.zeros(4, 3), bad)
