"""The lowest point among those of a step, and what follows from it: cloth comes to rest."""

import pytest
import torch

from tests.unit.physics.surrogate.conftest import make_problem
from toile.physics.surrogate.descent import Visited, dot, lowest_among
from toile.physics.surrogate.problem import StepProblem


class Quadratic(StepProblem):
    """A step whose potential is a quadratic form with given curvatures, lowest at zero."""

    curvatures: torch.Tensor

    def residual(self, positions):
        return -self.curvatures * positions * self.free[..., None]


def quadratic(curvatures):
    problem = make_problem(4, 4, batch=2)
    made = Quadratic(**{name: getattr(problem, name) for name in problem.__dataclass_fields__})
    object.__setattr__(made, "curvatures", curvatures)
    return made


def points(problem, count, seed=0):
    generator = torch.Generator().manual_seed(seed)
    shape = problem.prediction.shape
    first = torch.randn(shape, generator=generator, dtype=torch.float64)
    free = problem.free[..., None].double()
    others = [
        first + free * torch.randn(shape, generator=generator, dtype=torch.float64) for _ in range(count - 1)
    ]
    made = (first, *others)
    return Visited(made, tuple(problem.residual(p) for p in made))


def test_no_force_is_left_in_the_span_of_a_quadratic():
    g = torch.Generator().manual_seed(1)
    problem = quadratic(1 + 9 * torch.rand(2, 4, 4, 3, generator=g, dtype=torch.float64))
    visited = points(problem, 5)
    x, r = lowest_among(problem, visited).last
    for p in visited.points:
        along = dot((p - x) * problem.free[..., None], r)
        assert (along.abs() <= 1e-8).all()
    assert torch.equal(r, problem.residual(x))


def test_between_two_points_it_is_the_foot_of_the_line():
    """All curvatures alike: the lowest point of a line is the one nearest to the lowest of all."""
    problem = quadratic(torch.full((2, 4, 4, 3), 2.0, dtype=torch.float64))
    visited = points(problem, 2)
    first, second = visited.points
    x, _ = lowest_among(problem, visited).last
    free = problem.free[..., None]
    along = (first - second) * free
    share = -dot(along, second * free) / dot(along, along)
    torch.testing.assert_close(x, second + share[:, None, None, None] * along)


def test_directions_along_which_it_bends_down_are_left_out():
    """A saddle: the point must not go to the stationary point, which is higher."""
    curvatures = torch.ones(2, 4, 4, 3, dtype=torch.float64)
    curvatures[..., 0] = -1.0
    problem = quadratic(curvatures)
    visited = points(problem, 6)
    x, _ = lowest_among(problem, visited).last

    def potential(p):
        return 0.5 * (curvatures * p.square() * problem.free[..., None]).sum((1, 2, 3))

    assert (potential(x) <= potential(visited.points[-1]) + 1e-12).all()


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_point_that_is_not_finite_is_no_help_and_no_harm(bad):
    problem = quadratic(torch.full((2, 4, 4, 3), 3.0, dtype=torch.float64))
    visited = points(problem, 4)
    expected = lowest_among(problem, Visited(visited.points[1:], visited.forces[1:])).last[0]
    spoiled = visited.points[0].clone()
    spoiled[0, 1, 1, 0] = bad
    with_bad = Visited((spoiled, *visited.points[1:]), (problem.residual(spoiled), *visited.forces[1:]))
    found = lowest_among(problem, with_bad).last[0]
    torch.testing.assert_close(found[0], expected[0])
    assert found.isfinite().all()


def test_the_same_point_twice_says_nothing_new():
    problem = quadratic(torch.full((2, 4, 4, 3), 3.0, dtype=torch.float64))
    once = points(problem, 3)
    twice = Visited((once.points[0], *once.points), (once.forces[0], *once.forces))
    torch.testing.assert_close(lowest_among(problem, twice).last, lowest_among(problem, once).last)


def test_pinned_vertices_stay():
    problem = make_problem()
    x = problem.starts[:, 0]
    moved = x + 0.1 * problem.free[..., None]
    visited = Visited((x, moved), (problem.residual(x), problem.residual(moved)))
    found, _ = lowest_among(problem, visited).last
    pinned = problem.free == 0
    assert torch.equal(found[pinned], x[pinned])
