"""The pool: problems, what becomes of predictions, resets, determinism."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from toile.errors import InputError
from toile.learning.surrogate.energies import energies_by_term
from toile.learning.surrogate.pool import Pool, prediction_weights
from toile.learning.surrogate.resets import ResetRules, relative_residual

MakePool = Callable[..., Pool]
ALL = torch.arange(8)
FALL = 1  # the start that falls freely


def moved(pool: Pool, steps: int) -> Pool:
    """A pool whose cloths fall freely for some steps."""
    for _ in range(steps):
        pool.advance(ALL, pool.problem(ALL).starts[:, FALL])
    return pool


def test_new_cloths_are_at_rest(make_pool: MakePool) -> None:
    pool = make_pool(noise_share=0.0)
    problem = pool.problem(ALL)
    assert problem.starts.shape == (8, 4, 6, 7, 3)
    torch.testing.assert_close(problem.prediction, pool.states.history[:, 0])
    energies = energies_by_term(pool.states)
    assert (energies["stretching"] / problem.stiffness[:, 0]).max() < 1e-10
    # Edges at exactly right and straight angles are what a measured template does not have.
    assert (energies["shearing"] / problem.stiffness[:, 1]).max() < 4 * 0.04**2
    assert (energies["bending"] / problem.stiffness[:, 2]).max() < 4 * 0.04**2
    assert (pool.states.age == 0).all()


def test_masses_and_forces(make_pool: MakePool) -> None:
    pool = make_pool(noise_share=0.0)
    problem = pool.problem(ALL)
    assert problem.masses[2, 2] == 1
    assert problem.masses[0, 2] == problem.masses[2, -1] == 0.5
    assert problem.masses[0, 0] == 0.25
    free_fall = problem.starts[:, FALL] - problem.prediction
    inside = problem.free > 0
    acceleration = problem.forces / problem.masses[..., None]
    torch.testing.assert_close(free_fall[inside].float(), acceleration[inside], atol=1e-5, rtol=1e-5)


def test_prediction_formulas() -> None:
    weights = prediction_weights()
    torch.testing.assert_close(weights.sum(-1), torch.ones(2, 4).double())
    assert weights[0].tolist() == [[2, -1, 0, 0]] * 4
    assert weights[1, 0].tolist() == [2, -1, 0, 0]
    torch.testing.assert_close(weights[1, 3], torch.tensor([8 / 3, -22 / 9, 8 / 9, -1 / 9]).double())


def test_predictions_continue_a_steady_motion(make_pool: MakePool) -> None:
    pool = make_pool(noise_share=0.0, size=8)
    pool = moved(pool, 4)
    pool.states.steady.zero_()
    pool.states.turbulence.zero_()
    velocity = torch.tensor([0.3, -0.2, 0.1])
    # The centroid is all that moves.
    steps = torch.arange(4)[:, None, None, None] * velocity
    pool.states.history[:] = pool.states.history[:, :1] - steps
    problem = pool.problem(ALL)
    expected = pool.states.history[:, 0] + velocity
    torch.testing.assert_close(problem.prediction, expected, atol=1e-4, rtol=0)
    inside = problem.free > 0
    for start in problem.starts.unbind(1)[FALL:]:
        torch.testing.assert_close(start[inside], expected[inside], atol=1e-4, rtol=0)


def test_pinned_vertices_start_at_their_boundary_positions(make_pool: MakePool) -> None:
    pool = moved(make_pool(noise_share=1.0, noise=0.1), 3)
    problem = pool.problem(ALL)
    assert torch.equal((problem.free == 0).sum((1, 2)), pool.states.pinned.sum(1))
    before, again = pool.states.history[:, 0], pool.problem(ALL)
    for b, i, j in (problem.free == 0).nonzero().tolist():
        starts = problem.starts[b, :, i, j]
        assert torch.equal(starts, starts[:1].expand_as(starts))
        assert torch.equal(again.starts[b, 0, i, j], starts[0]), "noise leaves boundary positions alone"
        assert (starts[0] - before[b, i, j]).norm() < 1.0


def test_a_stiff_cloth_is_not_torn(make_pool: MakePool) -> None:
    pool = make_pool(size=64, noise_share=0.0)
    everyone = torch.arange(64)
    for _ in range(60):
        pool.advance(everyone, pool.problem(everyone).starts[:, FALL])
    x = pool.states.history[:, 0]
    pinned = pool.states.pinned
    top = pinned[:, 0] & pinned[:, 1]
    length = pool.states.rest_lengths_j[:, 0].sum(-1)
    assert top.any()
    assert ((x[:, 0, 0] - x[:, 0, -1]).norm(dim=-1)[top] <= 1.05 * length[top]).all()


def test_predictions_go_back_into_the_pool(make_pool: MakePool) -> None:
    pool = make_pool()
    some = torch.tensor([5, 2])
    others = torch.tensor([0, 1, 3, 4, 6, 7])
    before = pool.states.take(ALL)
    positions = pool.problem(some).starts[:, FALL] + 3.0
    pool.advance(some, positions)
    after = pool.states
    centre = positions.mean((1, 2), keepdim=True)
    torch.testing.assert_close(after.history[some, 0], positions - centre)
    torch.testing.assert_close(after.history[some, 1], before.history[some, 0] - centre)
    assert after.age[some].tolist() == [1, 1]
    assert not torch.equal(after.turbulence[some], before.turbulence[some])
    for name, tensor in after.tensors().items():
        assert torch.equal(tensor[others], before.tensors()[name][others]), name


def test_resets_replace_what_they_are_told_to(make_pool: MakePool) -> None:
    pool = moved(make_pool(), 2)
    before = pool.states.take(ALL)
    pool.reset(torch.tensor([3, 6]))
    assert pool.states.age.tolist() == [2, 2, 2, 0, 2, 2, 0, 2]
    assert not torch.equal(pool.states.stiffness[3], before.stiffness[3])
    assert torch.equal(pool.states.history[0], before.history[0])
    pool.reset(torch.tensor([], dtype=torch.int64))


def test_noise_changes_a_share_of_the_problems(make_pool: MakePool) -> None:
    pool = make_pool(size=400, noise_share=0.25, noise=0.01)
    everyone = torch.arange(400)
    change = pool.problem(everyone).prediction - pool.states.history[:, 0]
    noisy = change.abs().amax((1, 2, 3)) > 1e-4
    assert noisy.float().mean().item() == pytest.approx(0.25, abs=0.06)
    assert change[noisy].std().item() == pytest.approx(0.02, rel=0.1)


def test_batches_hold_no_cloth_twice(make_pool: MakePool) -> None:
    pool = make_pool()
    for _ in range(5):
        assert len(set(pool.draw(6).tolist())) == 6


def test_a_stored_pool_continues_bit_for_bit(make_pool: MakePool) -> None:
    whole = moved(make_pool(), 4)
    half = moved(make_pool(), 2)
    state = half.state_dict()
    moved(half, 1)  # what is stored does not change any more
    other = make_pool(seed=9)
    other.load_state_dict(state)
    moved(other, 2)
    for name, tensor in whole.states.tensors().items():
        assert torch.equal(tensor, other.states.tensors()[name]), name
    assert torch.equal(whole.draw(8), other.draw(8))


def test_another_seed_is_another_pool(make_pool: MakePool) -> None:
    assert not torch.equal(make_pool(0).states.stiffness, make_pool(1).states.stiffness)
    assert torch.equal(make_pool(1).states.stiffness, make_pool(1).states.stiffness)


def test_a_pool_of_another_grid_is_refused(make_pool: MakePool) -> None:
    with pytest.raises(InputError, match="does not fit"):
        make_pool().load_state_dict(make_pool(grid=(7, 7)).state_dict())
    with pytest.raises(InputError, match="3×3"):
        make_pool(grid=(2, 7))


def test_why_cloths_are_reset() -> None:
    rules = ResetRules(residual=20.0, strain=0.01, extent=50.0, probability=0.0)
    forces, stretching = torch.ones(6), torch.full((6,), 100.0)
    positions = torch.randn(6, 6, 7, 3, generator=torch.Generator().manual_seed(0))
    positions[1, 0, 0, 0] = 100.0
    positions[2, 3, 3, 1] = torch.nan
    residual = torch.tensor([1.0, 1.0, 1.0, 30.0, torch.nan, 1.0])
    age = torch.tensor([1, 9, 1, 1, 1, 9])
    resets = rules.apply(positions, residual, forces, stretching, age, 9, torch.Generator())
    assert resets.diverged.tolist() == [False, True, True, True, True, False]
    stiff = rules.apply(positions, residual, forces, 20 * stretching, age, 9, torch.Generator())
    assert stiff.diverged.tolist() == [False, True, True, False, True, False]
    assert resets.old.tolist() == [False, False, False, False, False, True]
    assert not resets.random.any()
    assert resets.any.tolist() == [False, True, True, True, True, True]
    assert not rules.apply(
        positions[:1], residual[:1], forces[:1], stretching[:1], age[1:2], None, torch.Generator()
    ).any.any()
    always = ResetRules(20.0, 0.01, 50.0, 1.0).apply(
        positions, residual, forces, stretching, age, None, torch.Generator()
    )
    assert always.any.all()


def test_relative_residual() -> None:
    forces = torch.tensor([0.0, 3.0, 4.0]).expand(2, 6, 7, 3)
    assert relative_residual(0.1 * forces, forces).tolist() == pytest.approx([0.1, 0.1])
