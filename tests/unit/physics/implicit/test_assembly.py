"""The Warp kernels against the pure energies: value, gradient, blocks and coupling, weights and orders."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.autograd.functional import hessian

from toile.physics.cloth import grid_cloth
from toile.physics.energies.term import InternalEnergy
from toile.physics.implicit.assembly import Assembly

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


def setting(shuffled, weighted, pinned, grid=GRID):
    """Assembly of one cloth, with the energies as a function of positions."""
    cloth = grid_cloth(grid, (STEP * (grid[0] - 1), STEP * (grid[1] - 1)), 0.2, pinned)
    rng = np.random.default_rng(5)
    n = cloth.n_vertices
    order = torch.from_numpy(rng.permutation(n)) if shuffled else torch.arange(n)
    energies = InternalEnergy([replace(term, stencil=order[term.stencil]) for term in cloth.energies])
    assembly = Assembly(n, energies, order[cloth.pinned].numpy())
    elements = energies.elements()
    if weighted:
        elements = elements.scaled(
            **{t.name: torch.from_numpy(rng.uniform(0.2, 2.0, len(t.stencil))) for t in energies}
        )
        bent = elements.rest["bending"].clone()
        bent[:, 1:] = torch.from_numpy(rng.normal(0.0, 0.4, (len(bent), 3)))
        elements = elements.with_rest(bending=bent)
        assembly.set_elements(elements)

    def terms(x):
        one = torch.ones(energies.n_coefficients, dtype=torch.float64)
        return torch.stack(list(energies.each(x, one, elements).values()))

    return assembly, terms, order


def dense(assembly, blocks):
    """The symmetric matrix of the blocks."""
    pattern = assembly.pattern
    full = np.zeros((assembly.n, 3, assembly.n, 3))
    full[pattern.columns, :, pattern.rows] = blocks.transpose(0, 2, 1)
    full[pattern.rows, :, pattern.columns] = blocks
    return full.reshape(3 * assembly.n, 3 * assembly.n)


@pytest.mark.parametrize("kind", ["crumpled", "nearly flat", "flat"])
@pytest.mark.parametrize(
    ("shuffled", "weighted", "pinned"),
    [
        (False, False, (0, 4)),
        (True, False, (0, 4)),
        (False, True, ()),
        (True, True, (7, 0, 29)),
        (False, False, tuple(range(5))),
    ],
)
def test_kernels_compute_the_pure_energies(kind, shuffled, weighted, pinned):
    assembly, terms, order = setting(shuffled, weighted, pinned)
    x = torch.empty(30, 3, dtype=torch.float64)
    x[order] = positions(kind)
    np.testing.assert_allclose(assembly.energies(x.numpy()), terms(x).numpy(), rtol=1e-10, atol=1e-24)

    exact = torch.autograd.functional.jacobian(terms, x).numpy()
    scale = np.abs(exact).max((1, 2), keepdims=True) + 1e-12
    # worst seen 4e-14
    assert (np.abs(assembly.gradients(x.numpy()) - exact) / scale).max() <= 1e-10

    full = hessian(lambda y: (torch.from_numpy(STIFFNESS) * terms(y)).sum(), x).reshape(90, 90).numpy()
    gradients, blocks = assembly.hessian(x.numpy(), STIFFNESS, convex=False)
    coupling = assembly.coupling(blocks)
    np.testing.assert_array_equal(gradients, assembly.gradients(x.numpy()))
    free = np.ones(30, bool)
    free[assembly.pinned] = False
    dofs = np.repeat(free, 3)
    # worst seen 9e-16 of the largest entry
    tolerance = 1e-12 * np.abs(full).max()
    np.testing.assert_allclose(dense(assembly, blocks), full, rtol=0, atol=tolerance)
    rows = (3 * assembly.pinned[:, None] + np.arange(3)).reshape(-1)
    np.testing.assert_allclose(coupling[:, dofs], full[np.ix_(rows, dofs)], rtol=0, atol=tolerance)
    assert not coupling[:, ~dofs].any()


@pytest.mark.parametrize("term", [0, 1, 2])
def test_hessian_of_each_energy_alone(term):
    """Stiffnesses differ by seven orders of magnitude; alone, none hides behind another."""
    assembly, terms, _ = setting(False, False, ())
    for kind in ("crumpled", "nearly flat", "flat"):
        x = positions(kind, seed=2)
        full = hessian(lambda y: terms(y)[term], x).reshape(90, 90).numpy()
        _, band = assembly.hessian(x.numpy(), np.eye(3)[term], convex=False)
        error = np.abs(dense(assembly, band) - full).max() / np.abs(full).max()
        assert error <= 1e-11, (kind, error)  # worst seen 2e-13


@pytest.mark.parametrize("kind", ["crumpled", "nearly flat"])
def test_convex_hessian_is_positive_semidefinite_and_exact_at_rest(kind):
    assembly, _, _ = setting(False, False, ())
    _, band = assembly.hessian(positions(kind).numpy(), STIFFNESS, convex=True)
    eigenvalues = np.linalg.eigvalsh(dense(assembly, band))
    assert eigenvalues.min() >= -1e-12 * eigenvalues.max()
    rest = positions("flat").numpy()
    _, convex = assembly.hessian(rest, STIFFNESS, convex=True)
    _, exact = assembly.hessian(rest, STIFFNESS, convex=False)
    np.testing.assert_allclose(convex, exact, rtol=0, atol=1e-12 * np.abs(exact).max())


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
    gradients, band = assembly.hessian(x, STIFFNESS, convex=False)
    assert np.isfinite(assembly.energies(x)).all()
    assert np.isfinite(gradients).all()
    assert np.isfinite(band).all()


def test_a_copy_in_another_process_computes_the_same():
    """Recorded launches stay behind; elements that were replaced go along."""
    x, rng = positions("crumpled").numpy(), np.random.default_rng(3)
    cloth = grid_cloth(GRID, (STEP * (GRID[0] - 1), STEP * (GRID[1] - 1)), 0.2, (0, 4))
    first = Assembly.of(cloth)

    def drawn(low, high, name):
        return torch.from_numpy(rng.uniform(low, high, len(cloth.energies.named(name).stencil)))

    plain = cloth.energies.elements()
    scaled = plain.scaled(**{term.name: drawn(0.5, 2.0, term.name) for term in cloth.energies})
    first.set_elements(
        scaled.with_rest(
            stretching=STEP * drawn(0.9, 1.1, "stretching"),
            shearing=drawn(1.2, 1.6, "shearing"),
            bending=torch.stack([drawn(0.0, 0.3, "bending") for _ in range(4)], dim=1),
        )
    )
    copy = pickle.loads(pickle.dumps(first))
    np.testing.assert_array_equal(copy.energies(x), first.energies(x))
    np.testing.assert_array_equal(copy.gradients(x), first.gradients(x))
    for a, b in zip(
        copy.hessian(x, STIFFNESS, convex=False), first.hessian(x, STIFFNESS, convex=False), strict=True
    ):
        np.testing.assert_array_equal(a, b)
    # And it is its own: elements that one replaces are not the other's.
    copy.set_elements(plain)
    assert not np.array_equal(copy.energies(x), first.energies(x))
