"""Derivatives of rollouts: autograd against finite differences, tangents and adjoints against autograd."""

import logging

import numpy as np
import pytest
import torch
from torch.autograd import gradcheck

from toile.physics.cloth import grid_cloth, grid_material
from toile.physics.frame_steps import FrameSteps
from toile.physics.implicit.integrators import BDF2, BackwardEuler
from toile.physics.implicit.linearized import LinearizedRollout, Perturbation
from toile.physics.implicit.newton import NewtonSettings
from toile.physics.implicit.simulator import ImplicitSimulator
from toile.physics.rollout import rollout
from toile.physics.state import State

GRID, SIZE, FRAMES = (4, 5), (0.15, 0.2), 4
UNEVEN = FrameSteps((0, 3, 4, 6))
TIGHT = NewtonSettings(tolerance=1e-11)
INTEGRATORS = {"backward Euler": BackwardEuler(), "BDF2": BDF2()}
NAMES = ["stretching", "shearing", "bending", "forces", "boundary", "positions", "velocities"]
# Units in which every input is of order one, so that finite differences and tolerances suit all alike.
UNITS = {
    "stretching": 50.0,
    "shearing": 3e-4,
    "bending": 3e-5,
    "forces": 5e-3,
    "boundary": 0.1,
    "positions": 0.1,
    "velocities": 0.3,
}


def simulator_of(integrator, substeps, pinned=(0, 4)):
    cloth = grid_cloth(GRID, SIZE, 0.2, pinned)
    per_frame = substeps if isinstance(substeps, int) else substeps.per_frame
    return ImplicitSimulator(cloth, 1 / 30 / per_frame, INTEGRATORS[integrator], TIGHT)


def inputs(simulator):
    """A bent cloth in motion under gravity and random forces, its pinned vertices moving."""
    cloth = simulator.cloth
    generator = torch.Generator().manual_seed(4)
    i, j = torch.meshgrid(
        torch.linspace(0, SIZE[0], GRID[0], dtype=torch.float64),
        torch.linspace(0, SIZE[1], GRID[1], dtype=torch.float64),
        indexing="ij",
    )
    x = torch.stack((j, i, 0.01 * torch.sin(20 * i + 9 * j)), -1).reshape(1, -1, 3)
    n = cloth.n_vertices
    noise = torch.randn(1, FRAMES - 1, n, 3, generator=generator, dtype=torch.float64)
    forces = cloth.masses[:, None] * (torch.tensor([0.0, 9.81, 1.0]).double() + noise)
    boundary = x[:, None, cloth.pinned] + 0.004 * torch.randn(
        1, FRAMES, len(cloth.pinned), 3, generator=generator, dtype=torch.float64
    ).cumsum(1)
    velocities = 0.1 * torch.randn(1, n, 3, generator=generator, dtype=torch.float64)
    values = [torch.tensor([UNITS[k]], dtype=torch.float64) for k in NAMES[:3]]
    return dict(zip(NAMES, [*values, forces, boundary, x, velocities], strict=True))


def simulate(simulator, given, substeps, **more):
    state = State.start(given["positions"], given["velocities"], simulator.time_step, simulator.n_past)
    material = grid_material(given["stretching"], given["shearing"], given["bending"])
    return rollout(simulator, state, material, given["forces"], given["boundary"], substeps, **more)


@pytest.mark.parametrize("substeps", [1, 2])
@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("name", NAMES)
def test_autograd_of_a_rollout_against_finite_differences(name, integrator, substeps):
    simulator = simulator_of(integrator, substeps)
    given = inputs(simulator)
    weights = torch.randn(1, FRAMES, 20, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    # Eight random directions stand for all the entries of a large input.
    size = given[name].numel()
    generator = torch.Generator().manual_seed(7)
    basis = torch.eye(size, dtype=torch.float64)
    if size > 8:
        basis = torch.randn(8, size, generator=generator, dtype=torch.float64) / size**0.5

    def loss(coefficients):
        value = given[name] + UNITS[name] * (coefficients @ basis).reshape(given[name].shape)
        motion = simulate(simulator, {**given, name: value}, substeps)
        # one number per frame: as many adjoints as frames, and no error can hide in a sum over frames
        return 10 * (weights * motion.positions).sum((0, 2, 3))

    at = torch.zeros(len(basis), dtype=torch.float64, requires_grad=True)
    assert gradcheck(loss, (at,), eps=1e-5, atol=1e-6, rtol=1e-6, nondet_tol=0.0)  # worst seen 1e-8


def pack(given, change):
    """Perturbation from arrays by name; pinned vertices of frame 0 move with their boundary positions."""
    return Perturbation(
        forces=change["forces"],
        stiffness=np.array([change["stretching"], change["shearing"], change["bending"]]),
        boundary=change["boundary"],
        positions=change["positions"],
        velocities=change["velocities"],
    )


def random_change(given, pinned, seed):
    rng = np.random.default_rng(seed)
    change = {k: UNITS[k] * rng.normal(size=v.shape[1:]) for k, v in given.items()}
    change["positions"][pinned] = change["boundary"][0]
    return change


def moved(given, change, by):
    return {k: v + by * torch.as_tensor(change[k]) for k, v in given.items()}


@pytest.mark.parametrize("substeps", [1, 3, UNEVEN])
@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("pinned", [(), (0, 4), (0, 1, 2, 3, 4)])
def test_tangent_against_finite_differences(integrator, substeps, pinned):
    simulator = simulator_of(integrator, substeps, pinned)
    given = inputs(simulator)
    base = simulate(simulator, given, substeps, linearize=True)
    change = random_change(given, simulator.cloth.pinned.numpy(), 0)
    tangent = LinearizedRollout(simulator, base).substep_tangent(pack(given, change))
    eps = 1e-6
    ahead, behind = (simulate(simulator, moved(given, change, s * eps), substeps) for s in (1, -1))
    numeric = ((ahead.all_positions - behind.all_positions) / (2 * eps))[0].numpy()
    scale = np.abs(numeric).max()
    assert np.abs(tangent - numeric).max() <= 1e-6 * scale  # worst seen 8e-8
    frames = LinearizedRollout(simulator, base).tangent(pack(given, change))
    np.testing.assert_array_equal(frames, base.frame_steps.at_frames(tangent))
    assert len(frames) == FRAMES


def dot(a, b):
    names = ("forces", "stiffness", "boundary", "positions", "velocities")
    return sum(float((getattr(a, k) * getattr(b, k)).sum()) for k in names)


@pytest.mark.parametrize("substeps", [1, 3, UNEVEN])
@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("pinned", [(), (0, 4)])
def test_adjoint_is_the_transpose_of_the_tangent(integrator, substeps, pinned):
    """<g, J d> = <Jᵀ g, d> for random g and d, to rounding."""
    simulator = simulator_of(integrator, substeps, pinned)
    given = inputs(simulator)
    linear = LinearizedRollout(simulator, simulate(simulator, given, substeps, linearize=True))
    assert linear.exact
    for seed in range(3):
        d = pack(given, random_change(given, simulator.cloth.pinned.numpy(), seed))
        g = np.random.default_rng(seed + 10).normal(size=(FRAMES, 20, 3))
        left, right = float((g * linear.tangent(d)).sum()), dot(linear.adjoint(g), d)
        scale = np.abs(g * linear.tangent(d)).sum()
        assert abs(left - right) <= 1e-12 * scale  # worst seen 7e-16


@pytest.mark.parametrize("substeps", [1, 3, UNEVEN])
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_adjoint_equals_autograd(integrator, substeps):
    simulator = simulator_of(integrator, substeps)
    given = {k: v.clone().requires_grad_() for k, v in inputs(simulator).items()}
    motion = simulate(simulator, given, substeps, linearize=True)
    g = torch.randn(FRAMES, 20, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    auto = dict(
        zip(NAMES, torch.autograd.grad((g * motion.positions[0]).sum(), tuple(given.values())), strict=True)
    )
    adjoint = LinearizedRollout(simulator, motion).adjoint(g.numpy())
    # LinearizedRollout ties the pinned vertices of frame 0 to their boundary positions; autograd tells them
    # apart.
    pinned = simulator.cloth.pinned
    expected = {k: v[0].clone() for k, v in auto.items()}
    expected["boundary"][0] += expected["positions"][pinned]
    expected["positions"][pinned] = 0
    assert not expected["velocities"][pinned].any()
    expected["stiffness"] = torch.stack([expected.pop(k) for k in NAMES[:3]])
    for name, value in expected.items():
        torch.testing.assert_close(
            torch.from_numpy(getattr(adjoint, name)), value, rtol=1e-11, atol=1e-13 * float(value.abs().max())
        )


def test_backward_without_kept_linearisation_is_the_same():
    simulator = simulator_of("BDF2", 2)
    gradients = []
    for linearize in (False, True):
        given = {k: v.clone().requires_grad_() for k, v in inputs(simulator).items()}
        motion = simulate(simulator, given, 2, linearize=linearize)
        gradients.append(torch.autograd.grad(motion.positions.square().sum(), tuple(given.values())))
    for a, b in zip(*gradients, strict=True):
        assert torch.equal(a, b)


def test_second_derivatives_are_refused_not_wrong():
    simulator = simulator_of("BDF2", 1)
    given = inputs(simulator)
    given["forces"].requires_grad_()
    loss = simulate(simulator, given, 1).positions.square().sum()
    (gradient,) = torch.autograd.grad(loss, given["forces"], create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        gradient.sum().backward()


def test_a_rollout_without_derivatives_is_refused():
    simulator = simulator_of("BDF2", 1)
    given = inputs(simulator)
    motion = simulate(simulator, given, 1)
    with pytest.raises(ValueError, match="linearize=True"):
        LinearizedRollout(simulator, motion)


@pytest.mark.parametrize("steps_before", [1, 3])
def test_tangent_of_a_window_that_begins_in_the_middle_of_a_motion(steps_before):
    """The past before the window is given; forces, stiffnesses and later boundary positions may change."""
    simulator = simulator_of("BDF2", 1)
    given = inputs(simulator)
    state = simulate(simulator, given, 1).steps[steps_before - 1].state
    pinned = simulator.cloth.pinned.numpy()
    change = random_change(given, pinned, 0)
    for name in ("positions", "velocities"):
        change[name][:] = 0
    change["boundary"][0] = 0

    def window(by, **more):
        at = moved(given, change, by)
        material = grid_material(at["stretching"], at["shearing"], at["bending"])
        return rollout(simulator, state, material, at["forces"], at["boundary"], 1, **more)

    tangent = LinearizedRollout(simulator, window(0.0, linearize=True)).tangent(pack(given, change))
    numeric = ((window(1e-6).positions - window(-1e-6).positions) / 2e-6)[0].numpy()
    assert np.abs(tangent - numeric).max() <= 1e-6 * np.abs(numeric).max()


def test_a_saddle_is_visible_in_the_derivatives(caplog):
    """Exactly flat cloth, squeezed in its plane, rests on top of its potential: no exact Cholesky factor."""
    cloth = grid_cloth((5, 5), (0.2, 0.2), 0.2, (0, 1, 2, 3, 4, 20, 21, 22, 23, 24))
    simulator = ImplicitSimulator(cloth, 1 / 30, BackwardEuler(), NewtonSettings())
    i, j = torch.meshgrid(*[torch.linspace(0, 0.2, 5, dtype=torch.float64)] * 2, indexing="ij")
    x = torch.stack((j, 0.9 * i, torch.zeros_like(i)), -1).reshape(1, -1, 3)
    given = {
        "stretching": torch.tensor([500.0]).double(),
        "shearing": torch.tensor([1e-4]).double(),
        "bending": torch.tensor([1e-6]).double(),
        "positions": x,
        "velocities": torch.zeros_like(x),
        "forces": torch.zeros(1, 1, 25, 3).double(),
        "boundary": x[:, None, cloth.pinned].expand(1, 2, -1, -1),
    }
    with caplog.at_level(logging.WARNING):
        motion = simulate(simulator, given, 1, linearize=True)
    assert not LinearizedRollout(simulator, motion).exact
    assert "saddle" in caplog.text
