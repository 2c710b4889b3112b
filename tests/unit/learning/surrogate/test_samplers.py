"""What is drawn at random: ranges, shares, and what must hold for every draw."""

from __future__ import annotations

import math

import pytest
import torch

from toile.errors import InputError
from toile.learning.surrogate.distributions import log_uniform, rotations
from toile.learning.surrogate.forces import ForceSampler, acceleration_field
from toile.learning.surrogate.materials import MaterialRanges
from toile.learning.surrogate.pinned_corners import PinnedCornerSampler, border_lengths, within_reach
from toile.learning.surrogate.rest_shapes import RestShapeSampler

N = 4000


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(3)


def test_log_uniform_covers_every_decade_alike(generator) -> None:
    values = log_uniform(N, (0.01, 10.0), generator)
    assert values.min() >= 0.01
    assert values.max() <= 10.0
    for decade in (-2, -1, 0):
        inside = (values >= 10.0**decade) & (values < 10.0 ** (decade + 1))
        assert inside.float().mean().item() == pytest.approx(1 / 3, abs=0.03)


def test_rotations_are_rotations_without_preferred_direction(generator) -> None:
    r = rotations(N, generator)
    torch.testing.assert_close(r @ r.mT, torch.eye(3).expand(N, 3, 3), atol=1e-5, rtol=0)
    torch.testing.assert_close(torch.linalg.det(r), torch.ones(N), atol=1e-5, rtol=0)
    assert r.mean(0).abs().max() < 0.05


def test_materials(generator) -> None:
    ranges = MaterialRanges((10.0, 1e4), (0.01, 10.0), (0.001, 10.0))
    values = ranges.sample(N, generator)
    assert values.shape == (N, 3)
    low, high = torch.tensor([10.0, 0.01, 0.001]), torch.tensor([1e4, 10.0, 10.0])
    assert (values >= low * 0.999).all()
    assert (values <= high * 1.001).all()


@pytest.mark.parametrize("bounds", [(0.0, 1.0), (2.0, 1.0), (1.0, math.inf), (1.0,)])
def test_ranges_that_cannot_be_drawn_from(bounds) -> None:
    with pytest.raises(InputError, match=r"materials\.shearing"):
        MaterialRanges((10.0, 1e4), bounds, (0.001, 10.0))


def test_a_rest_shape_is_at_rest(generator) -> None:
    shapes = RestShapeSampler(0.04).sample(200, (6, 7), generator)
    x = shapes.positions
    lengths_i = (x[:, 1:] - x[:, :-1]).norm(dim=-1)
    lengths_j = (x[:, :, 1:] - x[:, :, :-1]).norm(dim=-1)
    torch.testing.assert_close(lengths_i.float(), shapes.rest_lengths_i, atol=1e-5, rtol=0)
    torch.testing.assert_close(lengths_j.float(), shapes.rest_lengths_j, atol=1e-5, rtol=0)
    torch.testing.assert_close(x.mean((1, 2)), torch.zeros(200, 3).double(), atol=1e-5, rtol=0)
    # Flat: the smallest singular value vanishes.
    assert torch.linalg.svdvals(x.flatten(1, 2))[:, -1].max() < 1e-4
    deviation = shapes.rest_lengths_i.flatten(1).std(1)
    assert 0.01 < deviation.mean() < 0.03
    assert deviation.max() < 0.055
    assert shapes.rest_lengths_i.mean().item() == pytest.approx(1.0, abs=0.01)


def test_forces_scale_with_gravity(generator) -> None:
    sampler = ForceSampler((0.001, 0.7), 0.7, 1.0, 4, 0.95)
    forces = sampler.sample(N, generator)
    assert forces.gravity.min() >= 0.00099
    assert forces.gravity.max() <= 0.7001
    relative = forces.steady.norm(dim=-1) / forces.gravity
    assert 0.9 < relative.median() < 1.5
    assert (forces.turbulence_strength <= forces.gravity).all()
    assert (forces.steady / forces.gravity[:, None]).mean(0).abs().max() < 0.05


def test_turbulence_keeps_its_strength(generator) -> None:
    sampler = ForceSampler((0.1, 0.1), 0.0, 1.0, 4, 0.8)
    strength = torch.full((N,), 0.05)
    first = torch.randn((N, 4, 4, 3), generator=generator) * 0.05
    turbulence = first
    for _ in range(5):
        turbulence = sampler.next_turbulence(turbulence, strength, generator)
    assert turbulence.std().item() == pytest.approx(0.05, rel=0.02)
    correlation = (turbulence * first).mean() / (turbulence.std() * first.std())
    assert correlation.item() == pytest.approx(0.8**5, abs=0.02)


def test_the_field_has_the_coarse_values_at_its_corners(generator) -> None:
    steady, turbulence = torch.randn(3, 3, generator=generator), torch.randn(3, 4, 4, 3, generator=generator)
    field = acceleration_field(steady, turbulence, (6, 7))
    assert field.shape == (3, 6, 7, 3)
    torch.testing.assert_close(field[:, 0, 0], steady + turbulence[:, 0, 0], atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(field[:, -1, 0], steady + turbulence[:, -1, 0], atol=1e-5, rtol=1e-5)


def test_shares_of_pinned_corners(generator) -> None:
    pinned = PinnedCornerSampler((0.05, 0.1, 0.75, 0.1), 0.3, 0.3, 0.97).sample_pinned(N, generator)
    count = pinned.sum(1)
    for n, share in zip((0, 1, 2, 3, 4), (0.05, 0.1, 0.75, 0.0, 0.1), strict=True):
        assert (count == n).float().mean().item() == pytest.approx(share, abs=0.03)
    two = pinned[count == 2]
    assert (two & two.roll(1, 1)).any(1).all(), "two pinned corners are neighbours"
    assert two.float().mean(0).std() < 0.03, "every side alike"


def test_corner_velocities_keep_their_scale(generator) -> None:
    sampler = PinnedCornerSampler((0.0, 0.0, 1.0, 0.0), 0.3, 0.3, 0.9)
    speed = sampler.sample_speed(torch.full((N,), 0.25), generator)
    assert speed.max() <= 0.3 * 0.5
    constant = torch.full((N,), 0.1)
    velocities = sampler.sample_velocities(constant, generator)
    for _ in range(4):
        velocities = sampler.next_velocities(velocities, constant, generator)
    assert velocities.std().item() == pytest.approx(0.1 * (1 + 0.3**2) ** 0.5, rel=0.05)
    between = (velocities[:, 0] - velocities[:, 1]).std().item()
    assert between == pytest.approx(0.1 * 0.3 * 2**0.5, rel=0.05)


def test_pinned_corners_stay_within_reach(generator) -> None:
    corners = torch.randn(500, 4, 3, generator=generator) * 6
    lengths = torch.full((500, 4), 5.0)
    pinned = torch.zeros(500, 4, dtype=torch.bool)
    assert torch.equal(within_reach(corners, pinned, lengths), corners)
    pinned[:, :2] = True
    pulled = within_reach(corners, pinned, lengths)
    distance = (pulled[:, 0] - pulled[:, 1]).norm(dim=-1)
    assert distance.max() <= 5.0 + 1e-4
    assert torch.equal(pulled[:, 2:], corners[:, 2:])
    near = (corners[:, 0] - corners[:, 1]).norm(dim=-1) <= 5.0
    assert torch.equal(pulled[near], corners[near])
    # What they have in common stays.
    torch.testing.assert_close(pulled.mean(1), corners.mean(1), atol=1e-5, rtol=1e-5)
    everything = within_reach(corners, torch.ones(500, 4, dtype=torch.bool), lengths)
    torn = (everything - everything.roll(-1, 1)).norm(dim=-1) / lengths
    assert torn.max() < 1.2


def test_border_lengths_go_round() -> None:
    rest_i, rest_j = torch.zeros(1, 5, 7), torch.zeros(1, 6, 6)
    rest_j[:, 0], rest_i[:, :, -1], rest_j[:, -1], rest_i[:, :, 0] = 1.0, 2.0, 3.0, 4.0
    assert border_lengths(rest_i, rest_j).tolist() == [[6.0, 10.0, 18.0, 20.0]]


def test_unusable_settings_are_refused() -> None:
    with pytest.raises(InputError, match="scatter"):
        RestShapeSampler(0.5)
    with pytest.raises(InputError, match="pinned corners"):
        PinnedCornerSampler((0.5, 0.5, 0.5, 0.5), 0.3, 0.3, 0.97)
    with pytest.raises(InputError, match="turbulence"):
        ForceSampler((0.001, 0.7), 0.7, 1.0, 1, 0.95)
