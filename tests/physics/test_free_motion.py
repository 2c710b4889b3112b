"""Motion without pinned vertices: free fall, drift and momentum, where the answer is known in closed form."""

import numpy as np
import pytest
import torch

from toile.physics.cloth import grid_cloth, grid_material
from toile.physics.implicit.integrators import BDF2, BackwardEuler
from toile.physics.implicit.newton import NewtonSettings
from toile.physics.implicit.simulator import ImplicitSimulator
from toile.physics.rollout import rollout
from toile.physics.state import State

GRAVITY = torch.tensor([0.0, 9.81, 0.0], dtype=torch.float64)
GRID, SIZE = (7, 12), (0.3, 0.5)
TIGHT = NewtonSettings(tolerance=1e-10)


def one(value):
    return torch.tensor([value], dtype=torch.float64)


MATERIAL = grid_material(one(80.0), one(3e-4), one(1e-5))


def flat_cloth():
    cloth = grid_cloth(GRID, SIZE, 0.2, ())
    i, j = torch.meshgrid(
        torch.linspace(0, SIZE[0], GRID[0], dtype=torch.float64),
        torch.linspace(0, SIZE[1], GRID[1], dtype=torch.float64),
        indexing="ij",
    )
    return cloth, torch.stack((j, i, torch.ones_like(i)), -1).reshape(1, -1, 3)


def bent(x):
    """A gentle wave, not at rest."""
    wave = 0.02 * torch.sin(12 * x[..., 0] + 5 * x[..., 1])
    return x + torch.stack((torch.zeros_like(wave), torch.zeros_like(wave), wave), -1)


def move(cloth, x, v, h, integrator, n, force):
    simulator = ImplicitSimulator(cloth, h, integrator, TIGHT)
    forces = (cloth.masses[:, None] * force).expand(1, n, -1, 3) if force.ndim == 1 else force
    state = State.start(x, v, h, simulator.n_past)
    return rollout(simulator, state, MATERIAL, forces, torch.zeros(1, n + 1, 0, 3).double(), 1)


def bdf2_free_fall(n, h, g):
    """BDF2 on (x, v) as in the textbook, first step by backward Euler."""
    x, v = [0.0, g * h * h], [0.0, g * h]
    for _ in range(2, n + 1):
        v.append(4 / 3 * v[-1] - 1 / 3 * v[-2] + 2 / 3 * h * g)
        x.append(4 / 3 * x[-1] - 1 / 3 * x[-2] + 2 / 3 * h * v[-1])
    return np.array(x), np.array(v)


def test_free_fall_by_backward_euler_is_the_discrete_formula_at_every_vertex():
    """Border and corner vertices weigh less and are pulled less: all fall with exactly g."""
    cloth, x = flat_cloth()
    h, n = 1 / 60, 12
    motion = move(cloth, x, torch.zeros_like(x), h, BackwardEuler(), n, GRAVITY)
    k = torch.arange(n + 1, dtype=torch.float64)
    fall = 0.5 * h * h * k * (k + 1)
    expected = x[:, None] + fall[None, :, None, None] * GRAVITY
    torch.testing.assert_close(motion.positions, expected, rtol=0, atol=1e-12)  # worst seen 1e-14 m


def test_free_fall_by_bdf2_is_its_recurrence_at_every_vertex():
    cloth, x = flat_cloth()
    h, n = 1 / 60, 12
    motion = move(cloth, x, torch.zeros_like(x), h, BDF2(), n, GRAVITY)
    fall, speed = bdf2_free_fall(n, h, 9.81)
    expected = x[:, None] + torch.from_numpy(fall)[None, :, None, None] * GRAVITY / 9.81
    torch.testing.assert_close(motion.positions, expected, rtol=0, atol=1e-12)
    velocities = motion.steps[-1].state.velocities
    torch.testing.assert_close(
        velocities, (speed[-1] * GRAVITY / 9.81).expand_as(velocities), rtol=0, atol=1e-10
    )


@pytest.mark.parametrize(("integrator", "order"), [(BackwardEuler(), 1), (BDF2(), 2)])
def test_free_fall_converges_to_half_g_t_squared(integrator, order):
    cloth, x = flat_cloth()
    errors = []
    for n in (4, 8, 16):
        motion = move(cloth, x, torch.zeros_like(x), 0.2 / n, integrator, n, GRAVITY)
        errors.append(float((motion.positions[:, -1] - x - 0.5 * GRAVITY * 0.2**2).abs().max()))
    rates = np.log2(np.array(errors[:-1]) / errors[1:])
    # worst seen 0.018 off
    np.testing.assert_allclose(rates, order, atol=0.05)


@pytest.mark.parametrize("integrator", [BackwardEuler(), BDF2()])
def test_uniform_drift_is_exact(integrator):
    cloth, x = flat_cloth()
    v = torch.tensor([0.3, -0.2, 1.1], dtype=torch.float64).expand_as(x).contiguous()
    motion = move(cloth, x, v, 1 / 30, integrator, 10, torch.zeros(3).double())
    times = torch.arange(11, dtype=torch.float64) / 30
    expected = x[:, None] + times[None, :, None, None] * v[:, None]
    torch.testing.assert_close(motion.positions, expected, rtol=0, atol=1e-12)
    torch.testing.assert_close(motion.steps[-1].state.velocities, v, rtol=0, atol=1e-11)
    assert motion.newton_iterations == 0


def test_momentum_changes_by_the_impulse_of_external_forces():
    """Backward Euler: M (v_{n+1} - v_n) = h F_ext in sum over the cloth, whatever the internal forces do."""
    cloth, x = flat_cloth()
    generator = torch.Generator().manual_seed(0)
    h, n = 1 / 60, 8
    force = 5e-3 * torch.randn(1, n, 84, 3, generator=generator, dtype=torch.float64)
    v = 0.3 * torch.randn(1, 84, 3, generator=generator, dtype=torch.float64)
    motion = move(cloth, bent(x), v, h, BackwardEuler(), n, force)
    momentum = [(cloth.masses[:, None] * v[0]).sum(0)]
    momentum += [(cloth.masses[:, None] * s.state.velocities[0]).sum(0) for s in motion.steps]
    change = torch.stack(momentum).diff(dim=0)
    impulse = h * force[0].sum(1)
    torch.testing.assert_close(change, impulse, rtol=0, atol=1e-14)  # N s; worst seen 2e-17


def test_centre_of_mass_falls_like_a_point_with_bdf2():
    cloth, x = flat_cloth()
    h, n = 1 / 60, 12
    motion = move(cloth, bent(x), torch.zeros_like(x), h, BDF2(), n, GRAVITY)
    weights = cloth.masses / cloth.masses.sum()
    centre = (weights[:, None] * (motion.positions[0] - motion.positions[0, :1])).sum(1)
    fall, _ = bdf2_free_fall(n, h, 9.81)
    torch.testing.assert_close(centre[:, 1], torch.from_numpy(fall), rtol=0, atol=1e-11)
    assert centre[:, [0, 2]].abs().max() <= 1e-11
    # and it did unfold meanwhile
    assert (motion.positions[0, -1] - motion.positions[0, 0] - centre[-1]).abs().max() > 1e-3


@pytest.mark.parametrize("integrator", [BackwardEuler(), BDF2()])
def test_motion_does_not_depend_on_the_frame_of_reference(integrator):
    cloth, x = flat_cloth()
    generator = torch.Generator().manual_seed(1)
    q, _ = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64))
    q[:, 0] *= torch.det(q)
    shift = torch.tensor([0.4, -0.3, 1.0], dtype=torch.float64)
    start, v = bent(x), 0.1 * torch.randn(x.shape, generator=generator, dtype=torch.float64)
    here = move(cloth, start, v, 1 / 60, integrator, 4, GRAVITY).positions
    there = move(cloth, start @ q.T + shift, v @ q.T, 1 / 60, integrator, 4, q @ GRAVITY).positions
    torch.testing.assert_close(there, here @ q.T + shift, rtol=0, atol=1e-9)  # worst seen 2e-14 m
