"""Backpropagation through the surrogate: the same numbers as the kernels, and derivatives that are right."""

from dataclasses import fields

import pytest
import torch

from tests.unit.physics.surrogate.conftest import make_problem
from toile.physics.surrogate import kernels
from toile.physics.surrogate.differentiable import DifferentiableStepProblem


def plain(problem):
    return {field.name: getattr(problem, field.name) for field in fields(problem)}


def differentiable(problem, dtype=torch.float32):
    numbers = {name: t if t.dtype == torch.float64 else t.to(dtype) for name, t in plain(problem).items()}
    return DifferentiableStepProblem(**numbers)


def folded():
    """A sheet bent far, so that series and clamps of the angles end."""
    problem = make_problem(bent=1.5, seed=3)
    return problem, problem.starts[:, 0]


@pytest.mark.parametrize("bent", [0.0, 0.5, 1.5])
def test_forces_are_those_of_the_kernels(bent):
    problem = make_problem(bent=bent)
    x = problem.starts[:, 0]
    expected = problem.residual(x)
    found = differentiable(problem, torch.float64).residual(x).float()
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-4 * float(expected.abs().max()))


@pytest.mark.parametrize("axis", [0, 1])
def test_line_steps_are_those_of_the_kernels(axis):
    problem, x = folded()
    r = problem.residual(x)
    expected = problem.line_step(x, r, axis)
    found = differentiable(problem, torch.float64).line_step(x, r.double(), axis).float()
    torch.testing.assert_close(found, expected, rtol=1e-2, atol=2e-3 * float(expected.abs().max()))


@pytest.mark.parametrize("level", [0, 1])
def test_inputs_of_the_network_are_those_of_the_kernels(level):
    problem, x = folded()
    r = problem.residual(x)
    tension = problem.tensions(x)
    torch.testing.assert_close(differentiable(problem).tensions(x), tension, rtol=1e-3, atol=1e-3)
    pinned = 1 - problem.free
    expected = problem.vertex_inputs(x, r, tension, pinned, level)
    found = differentiable(problem).vertex_inputs(x, r, tension, pinned, level)
    for ours, theirs in zip(found, expected, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-3, atol=1e-4 * float(theirs.abs().max()))
    assert expected[1].shape[-1] == kernels.n_inputs(level)


def test_the_solution_is_that_of_the_kernels(surrogate, problem):
    expected, _ = surrogate.solve(problem, 2, 2)
    found, _ = surrogate.unrolled(differentiable(problem), 2, 2)
    moved = (expected - problem.best_start()).abs().max()
    assert (found - expected).abs().max() <= 1e-2 * moved


@pytest.mark.parametrize("name", ["starts", "prediction", "forces", "stiffness"])
def test_derivatives_in_single_precision_are_those_in_double(surrogate, name):
    found = []
    for dtype in (torch.float32, torch.float64):
        problem = differentiable(make_problem(9, 8), dtype)
        given = getattr(problem, name).clone().requires_grad_()
        asked = DifferentiableStepProblem(**{**plain(problem), name: given})
        solved, _ = surrogate.to(dtype).unrolled(asked, 2, 2)
        weights = torch.linspace(-1, 1, solved.numel(), dtype=torch.float64).view_as(solved)
        found.append(torch.autograd.grad((weights * solved).sum(), given)[0].double())
    assert (found[0] - found[1]).norm() <= 0.01 * found[1].norm()


@pytest.mark.parametrize("name", ["starts", "prediction", "forces", "stiffness"])
def test_derivatives_are_those_of_finite_differences(surrogate, name):
    surrogate = surrogate.double()
    problem = differentiable(make_problem(6, 5, batch=2), torch.float64)
    generator = torch.Generator().manual_seed(1)

    def solve(given):
        return surrogate.unrolled(DifferentiableStepProblem(**{**plain(problem), name: given}), 2, 1)[0]

    given = getattr(problem, name).clone().requires_grad_()
    weights = torch.randn(problem.prediction.shape, generator=generator, dtype=torch.float64)
    (slope,) = torch.autograd.grad((weights * solve(given)).sum(), given)
    direction = torch.randn(given.shape, generator=generator, dtype=torch.float64)
    direction = direction * (given.detach().abs() if name == "stiffness" else 0.1)
    h = 1e-6
    with torch.no_grad():
        ahead, behind = (solve(given + sign * h * direction) for sign in (1, -1))
    expected = float((weights * (ahead - behind)).sum() / (2 * h))
    assert float((slope * direction).sum()) == pytest.approx(expected, rel=1e-4)
