"""Banded and sparse Cholesky factorisation behind one interface, against dense solves."""

import pickle

import numpy as np
import pytest
import torch
from scipy.sparse import csr_array
from scipy.spatial import Delaunay

from toile.physics.cloth import grid_cloth, mesh_cloth
from toile.physics.implicit.assembly import Assembly
from toile.physics.implicit.integrators import BackwardEuler
from toile.physics.implicit.linear_solvers.analysis import SymbolicAnalysis
from toile.physics.implicit.linear_solvers.banded import BandedSolver
from toile.physics.implicit.linear_solvers.choice import banded_seconds, chosen_solver, sparse_seconds
from toile.physics.implicit.linear_solvers.dissection import nested_dissection
from toile.physics.implicit.linear_solvers.pattern import BlockPattern
from toile.physics.implicit.linear_solvers.sparse import SparseSolver
from toile.physics.implicit.linearized import LinearizedRollout, Perturbation
from toile.physics.implicit.newton import NewtonSettings
from toile.physics.implicit.simulator import ImplicitSimulator
from toile.physics.rollout import rollout
from toile.physics.state import State

SOLVERS = pytest.mark.parametrize("kind", [BandedSolver, SparseSolver])


def irregular_cloth(n, pinned, seed=0):
    """A square of n random vertices, triangulated; no two triangles are the same."""
    corners = np.array([[0.0, 0], [1, 0], [0, 1], [1, 1]])
    flat = np.concatenate((corners, np.random.default_rng(seed).uniform(0, 1, (n - 4, 2))))
    faces = Delaunay(flat).simplices.astype(np.int64)
    p = flat[faces]
    flipped = np.linalg.det(np.stack((p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), 1)) < 0
    faces[flipped] = faces[flipped][:, [0, 2, 1]]
    x = torch.from_numpy(np.column_stack((flat, np.zeros(n))))
    return x, mesh_cloth(x, torch.from_numpy(faces), 0.2, pinned, flat=True)


def pattern_of(name):
    """A pattern and its pinned vertices."""
    if name == "none":
        return BlockPattern.of_pairs(3, np.array([[0, 1]])), np.arange(3)
    if name == "one":
        return BlockPattern.of_pairs(1, np.zeros((0, 2), np.int64)), np.zeros(0, np.int64)
    if name == "dense":
        return BlockPattern.of_pairs(40, np.argwhere(np.ones((40, 40)))), np.array([3])
    if name == "star":
        return BlockPattern.of_pairs(60, np.array([[0, i] for i in range(1, 60)])), np.array([7])
    if name == "pieces":
        # A chain, a ring, and vertices of their own.
        chain = [[i, i + 1] for i in range(90)]
        ring = [[100 + i, 100 + (i + 1) % 80] for i in range(80)]
        return BlockPattern.of_pairs(200, np.array(chain + ring)), np.array([40, 110, 199])
    if name == "grid":
        cloth = grid_cloth((17, 11), (0.4, 0.3), 0.2, (0, 10))
    else:
        cloth = irregular_cloth(300, (0, 1, 57, 200))[1]
    return Assembly.of(cloth).pattern, cloth.pinned.numpy()


def system(pattern, pinned, shift=8.0, seed=0):
    """Random blocks and diagonal, and the dense matrix over the free unknowns with their numbers."""
    rng = np.random.default_rng(seed)
    blocks = rng.normal(size=(len(pattern.rows), 3, 3))
    diagonal = shift * (1 + rng.uniform(size=pattern.n_vertices)) * np.sqrt(pattern.n_vertices + 8)
    n = 3 * pattern.n_vertices
    dense = np.zeros((n, n))
    for block, i, j in zip(blocks, pattern.rows, pattern.columns, strict=True):
        dense[3 * i : 3 * i + 3, 3 * j : 3 * j + 3] = block
    dense = np.tril(dense) + np.tril(dense, -1).T + np.diag(np.repeat(diagonal, 3))
    free = np.setdiff1d(np.arange(n), 3 * pinned[:, None] + np.arange(3))
    return blocks, diagonal, dense[np.ix_(free, free)], free


@SOLVERS
@pytest.mark.parametrize("name", ["none", "one", "dense", "star", "pieces", "grid", "mesh"])
@pytest.mark.parametrize("shape", [(), (4,), (2, 3), (0,)])
def test_solves_like_a_dense_matrix(kind, name, shape):
    pattern, pinned = pattern_of(name)
    blocks, diagonal, dense, free = system(pattern, pinned)
    kept = blocks.copy(), diagonal.copy()
    right = np.random.default_rng(1).normal(size=(*shape, pattern.n_vertices, 3))
    given = right.copy()
    found = kind(pattern, pinned).factorise(blocks, diagonal).solve(right)
    rows = right.reshape(int(np.prod(shape)), 3 * pattern.n_vertices)
    expected = np.zeros_like(rows)
    expected[:, free] = np.linalg.solve(dense, rows[:, free].T).T
    np.testing.assert_allclose(found, expected.reshape(right.shape), rtol=1e-10, atol=1e-14)
    np.testing.assert_array_equal(right, given)
    np.testing.assert_array_equal(blocks, kept[0])
    np.testing.assert_array_equal(diagonal, kept[1])


@SOLVERS
def test_above_the_diagonal_nothing_is_read(kind):
    pattern, pinned = pattern_of("mesh")
    blocks, diagonal, _, _ = system(pattern, pinned)
    right = np.random.default_rng(1).normal(size=(pattern.n_vertices, 3))
    solver = kind(pattern, pinned)
    expected = solver.factorise(blocks, diagonal).solve(right)
    i, j = np.triu_indices(3, 1)
    blocks[pattern.diagonal[:, None], i, j] = np.nan
    np.testing.assert_array_equal(solver.factorise(blocks, diagonal).solve(right), expected)


@SOLVERS
@pytest.mark.parametrize("name", ["one", "grid", "mesh"])
@pytest.mark.parametrize("wrong", ["negative", "indefinite", "nan", "nan below", "infinite"])
def test_not_positive_definite_or_not_finite_gives_none(kind, name, wrong):
    pattern, pinned = pattern_of(name)
    blocks, diagonal, dense, _ = system(pattern, pinned)
    solver = kind(pattern, pinned)
    assert solver.factorise(blocks, diagonal) is not None
    free = np.setdiff1d(np.arange(pattern.n_vertices), pinned)
    one = free[len(free) // 2]
    if wrong == "negative":
        diagonal = -diagonal
    elif wrong == "indefinite":
        # Only the last digit of one eigenvalue is wrong: it shows in the last pivot at most.
        diagonal = diagonal - 1.01 * np.linalg.eigvalsh(dense)[0]
    elif wrong == "nan":
        diagonal[one] = np.nan
    elif wrong == "nan below":
        blocks[pattern.diagonal[one], 2, 0] = np.nan
    else:
        diagonal[one] = np.inf
    assert solver.factorise(blocks, diagonal) is None


@SOLVERS
def test_a_factor_outlives_the_next_one_and_repeats_exactly(kind):
    pattern, pinned = pattern_of("mesh")
    blocks, diagonal, _, _ = system(pattern, pinned)
    right = np.random.default_rng(1).normal(size=(pattern.n_vertices, 3))
    solver = kind(pattern, pinned)
    factor = solver.factorise(blocks, diagonal)
    first = factor.solve(right)
    solver.factorise(2 * blocks, 3 * diagonal).solve(right)
    np.testing.assert_array_equal(factor.solve(right), first)
    np.testing.assert_array_equal(kind(pattern, pinned).factorise(blocks, diagonal).solve(right), first)
    elsewhere = pickle.loads(pickle.dumps(factor))
    np.testing.assert_array_equal(elsewhere.solve(right), first)


def test_one_analysis_serves_all_solvers_of_a_pattern():
    pattern, pinned = pattern_of("mesh")
    again, _ = pattern_of("mesh")
    assert again is not pattern
    analysis = SparseSolver(pattern, pinned).analysis
    assert SparseSolver(again, pinned.copy()).analysis is analysis
    assert SparseSolver(pattern, pinned[:2]).analysis is not analysis


def test_dissection_separates_and_orders_every_vertex_once():
    pattern, _ = pattern_of("mesh")
    between = pattern.rows != pattern.columns
    p, q = pattern.rows[between], pattern.columns[between]
    graph = csr_array((np.ones(2 * len(p)), (np.r_[p, q], np.r_[q, p])), shape=(300, 300))
    parts = nested_dissection(graph, 24)
    np.testing.assert_array_equal(np.sort(np.concatenate(parts)), np.arange(300))
    for again, part in zip(nested_dissection(graph, 24), parts, strict=True):
        np.testing.assert_array_equal(again, part)
    part_of = np.empty(300, int)
    for number, part in enumerate(parts):
        part_of[part] = number
    # Leaves touch no other leaf, and without the last separator there are two pieces.
    leaves = [i for i, part in enumerate(parts) if not (part_of[graph[part].indices] < i).any()]
    assert len(leaves) > 5
    crossing = (part_of[p] != part_of[q]) & np.isin(part_of[p], leaves) & np.isin(part_of[q], leaves)
    assert not crossing.any()
    assert len(parts[-1]) < 60


def test_work_of_large_grids_grows_as_nested_dissection_promises():
    """N^1.5 operations and N log N entries, where a band has N² and N^1.5."""
    analyses = []
    for n in (40, 80):
        cloth = grid_cloth((n, n), (0.5, 0.5), 0.2, (0,))
        analyses.append(SymbolicAnalysis(Assembly.of(cloth).pattern, cloth.pinned.numpy()))
    assert analyses[1].flops / analyses[0].flops < 11  # N^1.5: 8; measured 9.4, N²: 16
    assert analyses[1].n_values / analyses[0].n_values < 6  # measured 5.3; N^1.5: 8


@pytest.mark.parametrize("shape", [(16, 16), (32, 32), (63, 63), (300, 12)])
def test_grids_of_published_results_stay_with_the_band(shape):
    cloth = grid_cloth(shape, (0.5, 0.5), 0.2, (0, shape[1] - 1))
    assert isinstance(chosen_solver(Assembly.of(cloth).pattern, cloth.pinned.numpy()), BandedSolver)


def test_the_choice_follows_the_predicted_times():
    _, cloth = irregular_cloth(3000, (0, 1))
    pattern, pinned = Assembly.of(cloth).pattern, cloth.pinned.numpy()
    solver = chosen_solver(pattern, pinned)
    assert isinstance(solver, SparseSolver)
    assert 2.5 * sparse_seconds(solver.analysis) < banded_seconds(BandedSolver(pattern, pinned))


def test_a_hung_sheet_and_its_derivatives_are_the_same_with_both_solvers():
    x, cloth = irregular_cloth(220, (0, 2))
    h, frames = 1 / 30, 5
    material = cloth.material(young=200.0, poisson=0.3, bending=1e-4)
    forces = (cloth.masses[:, None] * torch.tensor([0.0, 0.0, 9.81])).expand(1, frames - 1, -1, 3)
    boundary = x[cloth.pinned].repeat(1, frames, 1, 1)
    rng = np.random.default_rng(2)
    n, pinned = cloth.n_vertices, len(cloth.pinned)
    change = Perturbation(
        rng.normal(size=(frames - 1, n, 3)),
        rng.normal(size=cloth.energies.n_coefficients),
        rng.normal(size=(frames, pinned, 3)),
        rng.normal(size=(n, 3)),
        rng.normal(size=(n, 3)),
    )
    gradient = rng.normal(size=(frames, n, 3))
    results = []
    for kind in (BandedSolver, SparseSolver):
        simulator = ImplicitSimulator(cloth, h, BackwardEuler(), NewtonSettings(1e-10))
        simulator.solver = kind(simulator.assembly.pattern, simulator.assembly.pinned)
        state = State.start(x[None], torch.zeros_like(x)[None], h, simulator.n_past)
        motion = rollout(simulator, state, material, forces, boundary, 1, linearize=True)
        linear = LinearizedRollout(simulator, motion)
        assert linear.exact
        adjoint = linear.adjoint(gradient)
        results.append(
            (motion.positions[0].numpy(), linear.tangent(change), adjoint.forces, adjoint.stiffness)
        )
    assert np.abs(results[0][0][-1] - x.numpy()).max() > 0.05  # it has fallen
    for banded, sparse in zip(*results, strict=True):
        np.testing.assert_allclose(sparse, banded, rtol=1e-6, atol=1e-8 * np.abs(banded).max())
