"""The Warp kernels against the pure energies: value, gradient, band and coupling, weights and orders."""

import math
import pickle

import numpy as np
import pytest
import torch
from torch.autograd.functional import hessian

from toile.physics.cloth import grid_cloth
from toile.physics.energies.bending import bending_energy
from toile.physics.energies.shearing import shearing_energy
from toile.physics.energies.stretching import stretching_energy
from toile.physics.implicit.assembly import Assembly
from toile.physics.stencils import Stencils

GRID, STEP = (6, 5), 0.02
STIFFNESS = np.array([90.0, 3e-4, 2e-5])


def positions(kind, seed=0, grid=GRID):
    i, j = torch.meshgrid(torch.arange(grid[0]), torch.arange(grid[1]), indexing="ij")
    x = STEP * torch.stack((j, i, torch.zeros_like(i)), -1).reshape(-1, 3).double()
    if kind == "flat":
        return x
    amount = {"crumpled": 0.3, "nearly flat": 1e-3}[kind]
    generator = torch.Generator().manual_seed(seed)
    return x + amount * STEP * torch.randn(x.shape, generator=generator, dtype=torch.float64)


def setting(shuffled, weighted, held, grid=GRID):
    """Stencils, rest shape and weights of one cloth, with the energies as a function of positions."""
    cloth = grid_cloth(grid, (STEP * (grid[0] - 1), STEP * (grid[1] - 1)), 0.2, held)
    s = cloth.stencils
    rng = np.random.default_rng(5)
    order = torch.from_numpy(rng.permutation(s.n_vertices)) if shuffled else torch.arange(s.n_vertices)
    s = Stencils(s.n_vertices, order[s.edges], order[s.corners], order[s.straights])
    weights = None
    if weighted:
        weights = tuple(rng.uniform(0.2, 2.0, len(i)) for i in (s.edges, s.corners, s.straights))
    factors = [torch.from_numpy(w) for w in weights] if weights else [1.0, 1.0, 1.0]
    rest_angles = torch.full((len(s.corners),), math.pi / 2, dtype=torch.float64)
    assembly = Assembly(
        s, cloth.rest_lengths.numpy(), rest_angles.numpy(), order[cloth.held].numpy(), weights
    )

    def terms(x):
        return torch.stack(
            (
                stretching_energy(x, s.edges, cloth.rest_lengths, factors[0]),
                shearing_energy(x, s.corners, rest_angles, factors[1]),
                bending_energy(x, s.straights, factors[2]),
            )
        )

    return assembly, terms, order


def dense(assembly, band):
    """Symmetric matrix in the vertices' own order."""
    n, width = band.shape
    lower = np.zeros((n, n))
    for k in range(n):
        size = min(width, n - k)
        lower[k : k + size, k] = band[k, :size]
    full = lower + np.tril(lower, -1).T
    dof = assembly.to_band(np.arange(n, dtype=float).reshape(-1, 3)).astype(int)  # band row -> own dof
    own = np.empty_like(full)
    own[np.ix_(dof, dof)] = full
    return own


@pytest.mark.parametrize("kind", ["crumpled", "nearly flat", "flat"])
@pytest.mark.parametrize(
    ("shuffled", "weighted", "held"),
    [
        (False, False, (0, 4)),
        (True, False, (0, 4)),
        (False, True, ()),
        (True, True, (7, 0, 29)),
        (False, False, tuple(range(5))),
    ],
)
def test_kernels_compute_the_pure_energies(kind, shuffled, weighted, held):
    assembly, terms, order = setting(shuffled, weighted, held)
    x = torch.empty(30, 3, dtype=torch.float64)
    x[order] = positions(kind)
    np.testing.assert_allclose(assembly.energies(x.numpy()), terms(x).numpy(), rtol=1e-10, atol=1e-24)

    exact = torch.autograd.functional.jacobian(terms, x).numpy()
    scale = np.abs(exact).max((1, 2), keepdims=True) + 1e-12
    # worst seen 4e-14
    assert (np.abs(assembly.gradients(x.numpy()) - exact) / scale).max() <= 1e-10

    full = hessian(lambda y: (torch.from_numpy(STIFFNESS) * terms(y)).sum(), x).reshape(90, 90).numpy()
    gradients, band, coupling = assembly.hessian(x.numpy(), STIFFNESS, convex=False)
    np.testing.assert_array_equal(gradients, assembly.gradients(x.numpy()))
    free = np.ones(30, bool)
    free[assembly.held] = False
    dofs = np.repeat(free, 3)
    got = dense(assembly, band)
    # worst seen 9e-16 of the largest entry
    tolerance = 1e-12 * np.abs(full).max()
    np.testing.assert_allclose(got[np.ix_(dofs, dofs)], full[np.ix_(dofs, dofs)], rtol=0, atol=tolerance)
    assert not got[~dofs].any()
    rows = (3 * assembly.held[:, None] + np.arange(3)).reshape(-1)
    np.testing.assert_allclose(coupling[:, dofs], full[np.ix_(rows, dofs)], rtol=0, atol=tolerance)
    assert not coupling[:, ~dofs].any()


@pytest.mark.parametrize("term", [0, 1, 2])
def test_hessian_of_each_energy_alone(term):
    """Stiffnesses differ by seven orders of magnitude; alone, none hides behind another."""
    assembly, terms, _ = setting(False, False, ())
    for kind in ("crumpled", "nearly flat", "flat"):
        x = positions(kind, seed=2)
        full = hessian(lambda y: terms(y)[term], x).reshape(90, 90).numpy()
        _, band, _ = assembly.hessian(x.numpy(), np.eye(3)[term], convex=False)
        error = np.abs(dense(assembly, band) - full).max() / np.abs(full).max()
        assert error <= 1e-11, (kind, error)  # worst seen 2e-13


@pytest.mark.parametrize("kind", ["crumpled", "nearly flat"])
def test_convex_hessian_is_positive_semidefinite_and_exact_at_rest(kind):
    assembly, _, _ = setting(False, False, ())
    _, band, _ = assembly.hessian(positions(kind).numpy(), STIFFNESS, convex=True)
    eigenvalues = np.linalg.eigvalsh(dense(assembly, band))
    assert eigenvalues.min() >= -1e-12 * eigenvalues.max()
    rest = positions("flat").numpy()
    _, convex, _ = assembly.hessian(rest, STIFFNESS, convex=True)
    _, exact, _ = assembly.hessian(rest, STIFFNESS, convex=False)
    np.testing.assert_allclose(convex, exact, rtol=0, atol=1e-12 * np.abs(exact).max())


def test_shuffled_vertices_really_are_reordered():
    assembly, _, _ = setting(True, False, ())
    assert not assembly._natural
    x = np.random.default_rng(0).normal(size=(2, 30, 3))
    np.testing.assert_array_equal(assembly.from_band(assembly.to_band(x)), x)
    assert assembly.half_bandwidth < 3 * 29


@pytest.mark.parametrize("grid", [(2, 2), (2, 6), (9, 2), (7, 12)])
def test_narrow_and_odd_grids(grid):
    assembly, terms, _ = setting(False, False, (0,), grid)
    x = positions("crumpled", grid=grid)
    np.testing.assert_allclose(assembly.energies(x.numpy()), terms(x).numpy(), rtol=1e-12, atol=1e-24)
    exact = torch.autograd.functional.jacobian(terms, x).numpy()
    np.testing.assert_allclose(assembly.gradients(x.numpy()), exact, rtol=1e-9, atol=1e-11)


def test_complete_fold_is_finite():
    """Two edges folded back onto each other: the gradient has no direction, but nothing is infinite."""
    assembly, _, _ = setting(False, False, (), (2, 3))
    x = positions("flat", grid=(2, 3)).numpy().copy()
    x[[2, 5]] = x[[0, 3]]
    gradients, band, _ = assembly.hessian(x, STIFFNESS, convex=False)
    assert np.isfinite(assembly.energies(x)).all()
    assert np.isfinite(gradients).all()
    assert np.isfinite(band).all()


def test_a_copy_in_another_process_computes_the_same():
    """Recorded launches stay behind; elements that were replaced go along."""
    x, rng = positions("crumpled").numpy(), np.random.default_rng(3)
    cloth = grid_cloth(GRID, (STEP * (GRID[0] - 1), STEP * (GRID[1] - 1)), 0.2, (0, 4))
    s = cloth.stencils
    sizes = [len(i) for i in (s.edges, s.corners, s.straights)]
    first = Assembly(s, np.full(sizes[0], STEP), np.full(sizes[1], 1.5), np.array([0, 4]))
    first.set_elements(
        tuple(rng.uniform(0.5, 2.0, n) for n in sizes),
        STEP * rng.uniform(0.9, 1.1, sizes[0]),
        rng.uniform(1.2, 1.6, sizes[1]),
        rng.uniform(-0.3, 0.3, sizes[2]),
    )
    copy = pickle.loads(pickle.dumps(first))
    np.testing.assert_array_equal(copy.energies(x), first.energies(x))
    np.testing.assert_array_equal(copy.gradients(x), first.gradients(x))
    for a, b in zip(
        copy.hessian(x, STIFFNESS, convex=False), first.hessian(x, STIFFNESS, convex=False), strict=True
    ):
        np.testing.assert_array_equal(a, b)
    # And it is its own: elements that one replaces are not the other's.
    copy.set_elements(
        tuple(np.ones(n) for n in sizes), np.full(sizes[0], STEP), np.full(sizes[1], 1.5), np.zeros(sizes[2])
    )
    assert not np.array_equal(copy.energies(x), first.energies(x))
