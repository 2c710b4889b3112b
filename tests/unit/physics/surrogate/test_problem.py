"""Energies, forces and line relaxation of the surrogate against the plain functions."""

import dataclasses

import pytest
import torch

from tests.unit.physics.surrogate.conftest import grid_positions, make_problem
from toile.physics.energies.bending import bending_energy
from toile.physics.energies.shearing import shearing_energy
from toile.physics.energies.stretching import stretching_energy
from toile.physics.stencils import grid_stencils
from toile.physics.surrogate import kernels


def oracle(problem, x):
    batch, height, width, _ = x.shape
    s = grid_stencils(height, width)
    rest = torch.cat((problem.rest_lengths_i.flatten(1), problem.rest_lengths_j.flatten(1)), 1).double()
    k = problem.stiffness.double()
    flat = x.reshape(batch, -1, 3)
    return torch.stack(
        (
            stretching_energy(flat, s.edges, rest, k[:, 0:1]),
            shearing_energy(flat, s.corners, torch.pi / 2, k[:, 1:2]),
            bending_energy(flat, s.straights, k[:, 2:3]),
        ),
        1,
    )


@pytest.mark.parametrize("bent", [0.0, 0.5, 3.0])
def test_energies_and_gradient_are_those_of_the_plain_functions(bent):
    problem = make_problem(bent=bent)
    x = problem.starts[:, 0].clone().requires_grad_()
    expected = oracle(problem, x)
    (gradient,) = torch.autograd.grad(expected.sum(), x)
    given = (problem.stiffness, problem.rest_lengths_i, problem.rest_lengths_j)
    # float32 elements: relative to the largest force
    torch.testing.assert_close(kernels.energies(x.detach(), *given), expected.detach(), rtol=1e-4, atol=1e-6)
    scale = float(gradient.abs().max())
    assert (kernels.energy_gradient(x.detach(), *given) - gradient).abs().max() <= 2e-5 * scale


def test_residual_is_minus_the_gradient_of_the_potential(problem):
    x = problem.starts[:, 0]
    r = problem.residual(x)
    g = torch.Generator().manual_seed(1)
    direction = torch.randn(x.shape, generator=g).double() * problem.free[..., None]
    step = 1e-4
    slope = (problem.potential(x + step * direction) - problem.potential(x - step * direction)) / (2 * step)
    torch.testing.assert_close(-(r * direction).sum((1, 2, 3)), slope, rtol=2e-3, atol=1e-3)
    assert (r[problem.free == 0] == 0).all()


def test_coordinates_far_from_the_origin_cost_no_digits(problem):
    moved = dataclasses.replace(problem, prediction=problem.prediction + 1e4, starts=problem.starts + 1e4)
    near = problem.residual(problem.starts[:, 0])
    far = moved.residual(moved.starts[:, 0])
    assert (near - far).abs().max() <= 1e-3  # 1e4 * 1e-16 * Y, with room; float32 would give 5000


def test_relaxation_settles_a_stretched_line():
    problem = make_problem(bent=0.0)
    x = grid_positions(9, 8, 3)
    flat = dataclasses.replace(
        problem,
        prediction=x,
        forces=torch.zeros_like(problem.forces),
        rest_lengths_i=torch.ones_like(problem.rest_lengths_i),
        rest_lengths_j=torch.ones_like(problem.rest_lengths_j),
    )
    stretched = x.clone()
    stretched[:, 4:, :, 1] += 0.3  # one row of edges too long, in every column
    before = flat.residual(stretched)
    after_positions = stretched + flat.relaxation(stretched, before)
    after = flat.residual(after_positions)
    assert (flat.potential(after_positions) < 0.2 * flat.potential(stretched)).all()
    assert (after.abs().amax((1, 2, 3)) < 0.2 * before.abs().amax((1, 2, 3))).all()
    assert (after_positions[problem.free == 0] == stretched[problem.free == 0]).all()


def test_a_cloth_in_balance_is_not_relaxed():
    problem = make_problem(bent=0.0)
    x = grid_positions(9, 8, 3)
    assert (problem.relaxation(x, torch.zeros_like(problem.forces)) == 0).all()


def test_shapes_are_checked(problem):
    with pytest.raises(ValueError, match=r"masses: expected shape \(9, 8\), got \(8, 9\)"):
        dataclasses.replace(problem, masses=problem.masses.T)
