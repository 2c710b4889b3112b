"""Pinned cloth: equilibrium, tension, convergence in the time step, energy, failures, reproducibility."""

import numpy as np
import pytest
import torch

from toile.physics.cloth import grid_cloth, grid_material
from toile.physics.implicit.integrators import BDF2, BackwardEuler
from toile.physics.implicit.newton import NewtonSettings
from toile.physics.implicit.simulator import ImplicitSimulator
from toile.physics.rollout import rollout
from toile.physics.simulator import SimulationError, StepStatus
from toile.physics.state import State

G = 9.81


def one(value):
    return torch.tensor([value], dtype=torch.float64)


MATERIAL = grid_material(one(60.0), one(3e-4), one(3e-5))


def make(grid, size, pinned, bend=0.0):
    """A cloth in the x-y plane, y down, pinned along its top, with a small wave in z."""
    cloth = grid_cloth(grid, size, 0.2, pinned)
    i, j = torch.meshgrid(
        torch.linspace(0, size[0], grid[0], dtype=torch.float64),
        torch.linspace(0, size[1], grid[1], dtype=torch.float64),
        indexing="ij",
    )
    z = 1.0 + bend * torch.sin(3 * i / size[0] + 2 * j / size[1])
    return cloth, torch.stack((j, i, z), -1).reshape(1, -1, 3)


def gravity(cloth, n, direction=(0.0, 1.0, 0.0)):
    g = G * torch.tensor(direction, dtype=torch.float64)
    return (cloth.masses[:, None] * g).expand(1, n, -1, 3).contiguous()


def still(x, cloth, n_frames):
    return x[:, None, cloth.pinned].expand(1, n_frames, -1, -1).contiguous()


def run(cloth, x, h, integrator, n_frames, forces=None, boundary=None, substeps=1, material=MATERIAL, **more):
    settings = more.pop("settings", NewtonSettings(tolerance=1e-9))
    simulator = ImplicitSimulator(cloth, h, integrator, settings)
    state = State.start(x, torch.zeros_like(x), h, simulator.n_past)
    forces = gravity(cloth, n_frames - 1) if forces is None else forces
    boundary = still(x, cloth, n_frames) if boundary is None else boundary
    return rollout(simulator, state, material, forces, boundary, substeps, **more)


def internal_energy(cloth, x, material=MATERIAL):
    return cloth.energies.energy(x, cloth.energies.coefficients(material.values))


@pytest.mark.parametrize(("grid", "pinned"), [((9, 2), (0, 1)), ((7, 4), tuple(range(4)))])
def test_a_hanging_strip_carries_the_weight_below(grid, pinned):
    """Pinned along its whole top row: no force out of balance, and every edge carries what hangs below it."""
    cloth, x = make(grid, (0.4, 0.05 * (grid[1] - 1)), pinned)
    rest = run(cloth, x, 1.0, BackwardEuler(), 40).positions[:, -1]
    # out-of-balance force, by the pure energies
    y = rest.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(internal_energy(cloth, y).sum(), y)
    weight = gravity(cloth, 1)[:, 0]
    free = torch.ones(cloth.n_vertices, dtype=torch.bool)
    free[cloth.pinned] = False
    assert (weight - gradient)[:, free].abs().max() <= 1e-6 * weight.max()

    # What the holding hand feels is the weight of all that hangs from it, no more and no less.
    reaction = gradient[0, cloth.pinned].sum(0)
    hanging = weight[0, free].sum(0)
    torch.testing.assert_close(-reaction, hanging, rtol=1e-6, atol=1e-6 * float(hanging.max()))

    if grid[1] == 2:  # both columns alike: no shear between them
        columns = rest[0, :, 1].reshape(grid)
        tension = 60.0 * (columns.diff(dim=0) - 0.4 / (grid[0] - 1))
        below = G * cloth.masses.reshape(grid).flip(0).cumsum(0).flip(0)[1:]
        torch.testing.assert_close(tension, below, rtol=1e-6, atol=0)  # worst seen 5e-10
        assert rest[0, :, 0].reshape(grid).diff(dim=1).sub(0.05).abs().max() <= 1e-9


def test_half_the_stiffness_gives_twice_the_stretch():
    cloth, x = make((9, 2), (0.4, 0.05), (0, 1))
    ends = []
    for y in (60.0, 30.0):
        material = grid_material(one(y), one(3e-4), one(3e-5))
        ends.append(run(cloth, x, 1.0, BackwardEuler(), 60, material=material).positions[0, -1, -1, 1] - 0.4)
    assert float(ends[1] / ends[0]) == pytest.approx(2.0, rel=1e-5)


SWING = {}


def swing(integrator, n):
    """End of a swing of 0.16 s in n steps: two corners pinned, a force that comes and goes smoothly."""
    key = (type(integrator).__name__, n)
    if key not in SWING:
        cloth, x = make((5, 4), (0.2, 0.15), (0, 3))
        material = grid_material(one(5.0), one(3e-4), one(3e-4))
        phase = 2 * torch.pi * torch.arange(1, n + 1, dtype=torch.float64) / n
        forces = gravity(cloth, n, (0.0, 0.3, 1.4)) * (1 - torch.cos(phase))[:, None, None]
        SWING[key] = run(cloth, x, 0.16 / n, integrator, n + 1, forces, material=material).positions[0, -1]
    return SWING[key]


@pytest.mark.parametrize(("integrator", "order"), [(BackwardEuler(), 1), (BDF2(), 2)])
def test_converges_in_the_time_step(integrator, order):
    reference = swing(BDF2(), 1024)
    errors = [float((swing(integrator, n) - reference).norm()) for n in (64, 128, 256)]
    rates = np.log2(np.array(errors[:-1]) / errors[1:])
    np.testing.assert_allclose(rates, order, atol=0.15)  # measured 0.97, 0.98 and 1.94, 2.06


def test_two_steps_of_bdf2_keep_more_energy_than_four_of_backward_euler():
    """Pendulum swing of a cloth pinned along its top: total mechanical energy after 0.5 s."""
    lost = {}
    for name, integrator, substeps in (("BE", BackwardEuler(), 4), ("BDF2", BDF2(), 2)):
        cloth, x = make((6, 5), (0.3, 0.24), tuple(range(5)), bend=0.002)
        sideways = (0.0, 0.8, 0.6)
        forces = gravity(cloth, 15, sideways)
        motion = run(cloth, x, 1 / 30 / substeps, integrator, 16, forces, substeps=substeps)

        def total(state, cloth=cloth, forces=forces):
            kinetic = 0.5 * (cloth.masses[:, None] * state.velocities[0] ** 2).sum()
            potential = -(forces[0, 0] * state.positions[0]).sum()
            return float(kinetic + potential + internal_energy(cloth, state.positions)[0])

        start = State.start(x, torch.zeros_like(x), 1.0, 1)
        energies = [total(s.state) for s in motion.steps]
        kinetic = max(
            float(0.5 * (cloth.masses[:, None] * s.state.velocities[0] ** 2).sum()) for s in motion.steps
        )
        lost[name] = (total(start) - energies[-1]) / kinetic
    # measured 0.045 and 0.28 of the largest kinetic energy
    assert 0 < lost["BDF2"] < 0.5 * lost["BE"]


@pytest.mark.parametrize("integrator", [BackwardEuler(), BDF2()])
@pytest.mark.parametrize("pinned", [(), (0,), (0, 11), tuple(range(12)), (3, 40, 83)])
def test_pinned_vertices_follow_their_boundary_exactly(integrator, pinned):
    cloth, x = make((7, 12), (0.3, 0.5), pinned, bend=0.01)
    n = 5
    boundary = still(x, cloth, n).clone()
    boundary[..., 2] += 0.01 * torch.arange(n, dtype=torch.float64)[None, :, None] ** 2
    motion = run(cloth, x, 1 / 60, integrator, n, boundary=boundary, substeps=2)
    assert torch.equal(motion.positions[:, 1:, cloth.pinned], boundary[:, 1:])
    middle = torch.lerp(boundary[:, :-1], boundary[:, 1:], 0.5)
    assert torch.equal(motion.all_positions[:, 1::2, cloth.pinned], middle)
    assert all(s.status == (StepStatus.CONVERGED,) for s in motion.steps)


def test_too_few_iterations_are_reported_with_frame_and_advice():
    cloth, x = make((7, 6), (0.3, 0.25), (0, 5), bend=0.02)
    settings = NewtonSettings(max_iterations=1)
    with pytest.raises(
        SimulationError, match=r"frame 1, sub-step 1 of 2.*iteration limit.*Try more sub-steps"
    ):
        run(cloth, x, 1 / 60, BDF2(), 4, substeps=2, settings=settings)
    motion = run(cloth, x, 1 / 60, BDF2(), 2, settings=settings, throw=False)
    assert motion.steps[0].status == (StepStatus.MAX_ITERATIONS,)
    assert motion.steps[0].iterations == (1,)
    assert motion.steps[0].residual[0] > 0


@pytest.mark.parametrize("where", ["force", "pinned force", "position", "stiffness", "boundary"])
def test_nan_is_never_silent(where):
    cloth, x = make((5, 4), (0.2, 0.15), (0, 3))
    forces, boundary, material = gravity(cloth, 2), still(x, cloth, 3), MATERIAL
    if where == "force":
        forces[0, 1, 7, 2] = torch.nan
    elif where == "pinned force":
        forces[0, 1, 0, 2] = torch.nan
    elif where == "position":
        x = x.clone()
        x[0, 9] = torch.nan
    elif where == "boundary":
        boundary[0, 1, 0, 0] = torch.nan
    else:
        material = grid_material(one(torch.nan), one(3e-4), one(3e-5))
    with pytest.raises(SimulationError, match="not finite"):
        run(cloth, x, 1 / 60, BDF2(), 3, forces, boundary, material=material)
    motion = run(cloth, x, 1 / 60, BDF2(), 3, forces, boundary, material=material, throw=False)
    assert StepStatus.NOT_FINITE in [s.status[0] for s in motion.steps]


def test_nan_in_the_warm_start_is_harmless():
    cloth, x = make((5, 4), (0.2, 0.15), (0, 3), bend=0.01)
    cold = run(cloth, x, 1 / 60, BDF2(), 3)
    spoilt = run(cloth, x, 1 / 60, BDF2(), 3, warm_start=torch.full_like(cold.all_positions, torch.nan))
    torch.testing.assert_close(spoilt.positions, cold.positions, rtol=0, atol=1e-12)


def test_runs_are_bit_identical():
    cloth, x = make((7, 6), (0.3, 0.25), (0, 5), bend=0.02)
    first = run(cloth, x, 1 / 60, BDF2(), 5, substeps=2)
    again = run(cloth, x, 1 / 60, BDF2(), 5, substeps=2)
    assert torch.equal(first.all_positions, again.all_positions)


@pytest.mark.parametrize("kind", ["same", "similar", "far"])
def test_a_warm_start_changes_the_work_not_the_answer(kind):
    cloth, x = make((7, 6), (0.3, 0.25), (0, 5), bend=0.02)
    settings = NewtonSettings(tolerance=1e-8)
    cold = run(cloth, x, 1 / 120, BDF2(), 6, substeps=2, settings=settings)
    warm_start = cold.all_positions.clone()
    if kind == "similar":
        warm_start += 1e-4 * torch.sin(30 * warm_start)
    elif kind == "far":
        warm_start += 0.02 * torch.sin(300 * warm_start)
    warm = run(cloth, x, 1 / 120, BDF2(), 6, substeps=2, settings=settings, warm_start=warm_start)
    difference = (warm.positions - cold.positions).abs().max()
    assert difference <= 1e-8  # m; worst seen 6e-11
    if kind == "same":
        assert warm.newton_iterations == 0
    else:
        assert warm.newton_iterations <= cold.newton_iterations


def test_buckling_under_moving_corners_converges():
    """Approaching corners push flat cloth out of its plane; one step per frame, on soft cloth."""
    cloth, x = make((12, 12), (0.3, 0.3), (0, 11), bend=1e-3)
    n = 8
    boundary = still(x, cloth, n).clone()
    boundary[:, :, 0, 0] += 0.008 * torch.arange(n, dtype=torch.float64)
    material = grid_material(one(100.0), one(1e-4), one(3e-6))
    motion = run(cloth, x, 1 / 30, BDF2(), n, boundary=boundary, material=material, settings=NewtonSettings())
    assert motion.positions[0, -1, :, 2].std() > 5e-3
    assert all(s.residual[0] <= 1e-6 * float(cloth.masses.max()) * G for s in motion.steps)
