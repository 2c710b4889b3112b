"""Banded Cholesky factorisation and bandwidth order."""

import numpy as np
import pytest

from toile.physics.implicit.linear_solvers.banded import BandedCholesky, bandwidth_order
from toile.physics.stencils import grid_stencils


def random_banded(n, half, seed, shift):
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(n, n))
    a = np.where(np.abs(np.subtract.outer(np.arange(n), np.arange(n))) <= half, a + a.T, 0.0)
    a += shift * np.eye(n)
    band = np.zeros((n, half + 1))
    for k in range(n):
        column = a[k : k + half + 1, k]
        band[k, : len(column)] = column
    return a, band


@pytest.mark.parametrize(("n", "half"), [(1, 0), (7, 6), (40, 5), (60, 40)])
@pytest.mark.parametrize("shape", [(), (3,), (2, 2)])
def test_solves_like_a_dense_matrix(n, half, shape):
    a, band = random_banded(n, half, 0, shift=4.0 * (half + 1))
    right = np.random.default_rng(1).normal(size=(*shape, n))
    kept = right.copy()
    factor = BandedCholesky.factorise(band)
    got = factor.solve(right)
    expected = np.linalg.solve(a, right.reshape(-1, n).T).T.reshape(right.shape)
    np.testing.assert_allclose(got, expected, rtol=1e-12, atol=1e-14)  # worst seen 5e-15 relative
    np.testing.assert_array_equal(right, kept)


@pytest.mark.parametrize("shift", [-100.0, 0.0])
def test_not_positive_definite_gives_none(shift):
    a, band = random_banded(30, 4, 0, shift)
    assert np.linalg.eigvalsh(a).min() < 0
    assert BandedCholesky.factorise(band) is None


def test_nan_gives_none():
    _, band = random_banded(30, 4, 0, 50.0)
    band[3, 0] = np.nan
    assert BandedCholesky.factorise(band) is None


def test_a_row_major_grid_keeps_its_order_and_a_shuffled_one_gets_a_narrow_band():
    stencils = grid_stencils(12, 5)
    pairs = np.concatenate([stencils.edges.numpy(), stencils.straights.numpy()[:, [0, 2]]])
    position, half = bandwidth_order(60, pairs)
    assert half <= 10  # 2 · W: bending couples next neighbours but one
    shuffle = np.random.default_rng(0).permutation(60)
    _, half_of_random = bandwidth_order(60, shuffle[pairs])
    assert np.abs(np.diff(shuffle[pairs], axis=1)).max() > 40
    assert half_of_random <= 20
    assert sorted(position) == list(range(60))
