"""The contact potential against finite differences and torch; penalty and slip potential are smooth."""

from itertools import combinations

import numpy as np
import pytest

from toile.physics.contact.planes import ContactPlanes, ContactPotential, Penalty, slip_potential, slip_slopes
from toile.physics.implicit.linear_solvers.pattern import BlockPattern

N = 6
PENALTY = Penalty(smoothing=5e-4, hardening=1e-3)
STICKING = 2e-3


def contacts(friction: float) -> tuple[ContactPotential, np.ndarray, np.ndarray]:
    """Single vertices and places on faces, deep and shallow, sticking and sliding; x_n and x."""
    generator = np.random.default_rng(3)
    x = generator.normal(size=(N, 3))
    vertices = np.array([[0, 0, 0], [1, 1, 1], [2, 2, 2], [0, 1, 2], [3, 4, 5], [1, 3, 4]])
    weights = np.array([[1.0, 0, 0]] * 3 + [[0.2, 0.3, 0.5], [0.6, 0.1, 0.3], [0.0, 0.5, 0.5]])
    normals = generator.normal(size=(6, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = np.einsum("ca,cak->ck", weights, x[vertices])
    depths = np.array([2e-4, 1e-3, -1e-3, 3e-3, 4e-4, 8e-4])
    planes = ContactPlanes(
        vertices=vertices,
        weights=weights,
        normals=normals,
        offsets=(normals * points).sum(1) + depths,
        stiffness=generator.uniform(20, 60, 6),
        normal_forces=generator.uniform(0.01, 0.05, 6),
        drags=1e-3 * generator.normal(size=(6, 3)),
    )
    start = x - 1e-3 * generator.normal(size=x.shape) * np.array([0.3, 5, 1, 0.2, 3, 1])[:, None]
    return ContactPotential(planes, start, friction, PENALTY, STICKING), start, x


def dense(potential: ContactPotential, x: np.ndarray) -> np.ndarray:
    pattern = BlockPattern.of_pairs(N, np.array(list(combinations(range(N), 2))))
    blocks = np.zeros((len(pattern.rows), 3, 3))
    potential.add_hessian(blocks, pattern, x, convex=False)
    full = np.zeros((3 * N, 3 * N))
    for block, row, column in zip(blocks, pattern.rows, pattern.columns, strict=True):
        full[3 * row : 3 * row + 3, 3 * column : 3 * column + 3] = block
        full[3 * column : 3 * column + 3, 3 * row : 3 * row + 3] = block.T
    return full


@pytest.mark.parametrize("friction", [0.0, 0.7])
def test_derivatives_are_those_of_finite_differences(friction: float) -> None:
    potential, _, x = contacts(friction)
    free = np.ones(x.shape)
    gradient, hessian = potential.gradient(x).reshape(-1), dense(potential, x)
    by_total, by_gradient = np.zeros(3 * N), np.zeros((3 * N, 3 * N))
    for k in range(3 * N):
        step = np.zeros(3 * N)
        step[k] = 1e-7
        ends = [x + sign * step.reshape(x.shape) for sign in (1, -1)]
        by_total[k] = (potential.total(ends[0], free) - potential.total(ends[1], free)) / 2e-7
        by_gradient[k] = (potential.gradient(ends[0]) - potential.gradient(ends[1])).reshape(-1) / 2e-7
    np.testing.assert_allclose(gradient, by_total, rtol=0, atol=1e-6 * np.abs(gradient).max())
    np.testing.assert_allclose(hessian, by_gradient, rtol=0, atol=1e-5 * np.abs(hessian).max())
    assert np.linalg.eigvalsh(hessian).min() > -1e-9 * np.abs(hessian).max()


def test_the_penalty_is_zero_outside_and_twice_smooth() -> None:
    assert PENALTY.value(np.array([-1.0, 0.0])).tolist() == [0.0, 0.0]
    for at in (0.0, PENALTY.smoothing):
        around = at + np.array([-1e-12, 1e-12])
        for function in (PENALTY.value, PENALTY.slope, PENALTY.curvature):
            below, above = function(around)
            assert below == pytest.approx(above, abs=1e-8)
    # Its force at the depth of hardening is about twice the parabola's.
    assert PENALTY.slope(np.array([1e-3]))[0] == pytest.approx(2e-3, rel=0.15)


def test_slip_is_coulombs_beyond_the_sticking_displacement() -> None:
    s = np.array([0.0, 0.5e-3, 2e-3, 5e-3])
    by_length, _ = slip_slopes(s, STICKING)
    force = by_length * s
    np.testing.assert_allclose(force, [0.0, 2 * 0.25 - 0.0625, 1.0, 1.0])
    steps = np.linspace(0, 4e-3, 4001)
    slopes = np.gradient(slip_potential(steps, STICKING), steps)
    np.testing.assert_allclose(slopes[1:-1], (slip_slopes(steps, STICKING)[0] * steps)[1:-1], atol=1e-3)
