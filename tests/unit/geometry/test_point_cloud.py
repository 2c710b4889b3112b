"""Cleaning point clouds, and the surface they show."""

from __future__ import annotations

import numpy as np
import pytest

from toile.errors import InputError
from toile.geometry.point_cloud import largest_cluster, require_enough, seen_surface, smooth_depth
from toile.geometry.surface import border_of_disc


def lattice(n: int) -> np.ndarray:
    x, y = np.meshgrid(np.arange(n) + 0.5, np.arange(n) + 0.5)
    return np.column_stack((x.ravel(), y.ravel()))


def test_depth_of_a_plane_is_exact_inside_and_beyond_the_samples() -> None:
    pixels = np.random.default_rng(0).uniform(0, 100, (3000, 2))

    def depth(p):
        return 1 / (0.8 + 0.002 * p[:, 0] - 0.001 * p[:, 1])

    at = np.array([[50.0, 50.0], [3.0, 97.0], [-2.0, 50.0]])
    found, distance = smooth_depth(pixels, depth(pixels), at, radius=10.0)
    np.testing.assert_allclose(found, depth(at), rtol=1e-7)
    assert distance[2] > 2
    assert distance[0] < 3


def test_noise_is_averaged_and_strays_are_ignored() -> None:
    random = np.random.default_rng(0)
    pixels = random.uniform(0, 100, (6000, 2))
    truth = 1.2 + 0.02 * np.sin(pixels[:, 0] / 20)
    depth = truth + random.normal(0, 0.001, len(truth))
    depth[::40] += 0.05
    at = random.uniform(10, 90, (200, 2))
    found, _ = smooth_depth(pixels, depth, at, radius=8.0)
    error = found - (1.2 + 0.02 * np.sin(at[:, 0] / 20))
    assert np.sqrt((error**2).mean()) < 0.0003
    assert np.abs(error).max() < 0.0012


def test_cluster_drops_strays_and_other_objects() -> None:
    random = np.random.default_rng(0)
    cloth = random.uniform(0, 1, (3000, 3)) * [1, 1, 0.01]
    other = random.uniform(0, 0.3, (300, 3)) * [1, 1, 0.01] + [0, 0, 0.5]
    strays = random.uniform(-1, 2, (30, 3))
    kept = largest_cluster(np.concatenate((cloth, other, strays)))
    assert kept[:3000].mean() > 0.99
    assert not kept[3000:3300].any()
    assert kept[3300:].sum() <= 2


def test_jump_in_depth_is_not_bridged() -> None:
    pixels = lattice(30)
    right = pixels[:, 0] > 20
    positions = np.column_stack((pixels * 0.01, np.where(right, 1.5, 1.0)))
    mesh = seen_surface(pixels, positions, np.ones((30, 30), bool), 0.05, "here")
    assert len(mesh.vertices) == 20 * 30
    np.testing.assert_array_equal(mesh.vertices[:, 2], 1.0)
    assert len(border_of_disc(mesh, "here")) == 2 * (19 + 29)


def test_surface_stays_in_its_region_and_is_not_pinched() -> None:
    pixels = lattice(20)
    region = np.zeros((20, 20), bool)
    region[2:10, 2:10] = region[10:16, 10:16] = True  # two squares that touch at a corner
    mesh = seen_surface(pixels, np.column_stack((pixels, np.ones(400))), region, 9.0, "here")
    assert mesh.vertices[:, :2].max() < 11
    border_of_disc(mesh, "here")


def test_nothing_left() -> None:
    pixels = lattice(10)
    with pytest.raises(InputError, match="no surface"):
        seen_surface(pixels, np.column_stack((pixels, np.ones(100))), np.zeros((10, 10), bool), 9.0, "here")
    with pytest.raises(InputError, match="Too few points inside"):
        require_enough(10, "here", "inside the mask")
