"""The surrogate behind the simulator interface: units, energy, accuracy, clear errors."""

import dataclasses

import pytest
import torch

from toile.errors import InputError
from toile.physics.cloth import grid_cloth, grid_material
from toile.physics.energies.bending import bending_energy
from toile.physics.energies.shearing import Shearing, shearing_energy
from toile.physics.energies.stretching import stretching_energy
from toile.physics.energies.term import InternalEnergy
from toile.physics.hybrid.simulator import HybridSimulator
from toile.physics.implicit.integrators import BDF2, BackwardEuler
from toile.physics.implicit.newton import NewtonSettings
from toile.physics.implicit.simulator import ImplicitSimulator
from toile.physics.rollout import rollout
from toile.physics.state import State
from toile.physics.surrogate.simulator import SurrogateSimulator
from toile.physics.topology import Topology

GRID, SIZE, STEP = (12, 12), (0.3, 0.3), 0.01
GRAVITY = torch.tensor([0.0, 8.0, 5.6], dtype=torch.float64)


def cloth_of(density=0.15, **changes):
    cloth = grid_cloth(GRID, SIZE, density, (0, GRID[1] - 1))
    return dataclasses.replace(cloth, **changes) if changes else cloth


def skewed(energies):
    stretching, shearing, bending = energies
    return InternalEnergy((stretching, Shearing(shearing.stencil, 0.9 * shearing.rest), bending))


def flat():
    i, j = torch.meshgrid(*(torch.linspace(0, s, n) for s, n in zip(SIZE, GRID, strict=True)), indexing="ij")
    return torch.stack((j, i, torch.zeros_like(i)), -1).double().reshape(1, -1, 3)


def move(simulator, steps=30, scale=1.0):
    """A sheet that swings down from its two upper corners."""
    x = flat()
    material = grid_material(*(scale * torch.tensor([k], dtype=torch.float64) for k in (100.0, 3e-4, 3e-5)))
    forces = (simulator.cloth.masses[:, None] * GRAVITY).expand(1, steps, -1, -1).contiguous()
    boundary = x[:, None, simulator.cloth.pinned].expand(1, steps + 1, -1, -1).contiguous()
    state = State.start(x, 0 * x, simulator.time_step, simulator.n_past)
    return rollout(simulator, state, material, forces, boundary, 1)


@pytest.mark.parametrize("integrator", [BackwardEuler(), BDF2()])
def test_follows_the_solver(integrator):
    exact = move(ImplicitSimulator(cloth_of(), STEP, integrator, NewtonSettings())).positions
    away = [
        float(
            (move(SurrogateSimulator(cloth_of(), STEP, integrator, n)).positions - exact).norm(dim=-1).mean()
        )
        for n in (1, 2, 4)
    ]
    assert away[1] <= 0.01 * SIZE[0]
    assert away[0] > away[1] > away[2]


def test_one_correction_by_newton_brings_it_to_the_solver():
    exact = move(ImplicitSimulator(cloth_of(), STEP, BDF2(), NewtonSettings())).positions

    def predictor(cloth, h):
        return SurrogateSimulator(cloth, h, BDF2(), 1)

    alone = move(predictor(cloth_of(), STEP)).positions
    hybrid = move(HybridSimulator(cloth_of(), STEP, BDF2(), predictor, corrections=1)).positions
    assert (hybrid - exact).abs().mean() <= 0.1 * (alone - exact).abs().mean()


def energies(cloth, x):
    """Kinetic energy, and with it all of it, after every step; materials as in ``move``."""
    v = torch.diff(x, dim=0) / STEP
    s = cloth.stencils
    internal = (
        stretching_energy(x, s.edges, cloth.rest_lengths, 100.0)
        + shearing_energy(x, s.corners, torch.pi / 2, 3e-4)
        + bending_energy(x, s.straights, 3e-5)
    )
    kinetic = 0.5 * (cloth.masses[:, None] * v.square()).sum((1, 2))
    return kinetic, internal[1:] + kinetic - (cloth.masses[:, None] * GRAVITY * x[1:]).sum((1, 2))


def test_backward_euler_never_gains_energy():
    simulator = SurrogateSimulator(cloth_of(), STEP, BackwardEuler(), 1)
    kinetic, total = energies(simulator.cloth, move(simulator, steps=60).positions[0])
    assert (torch.diff(total) <= 1e-4 * kinetic.max()).all()


def test_a_step_loses_what_its_change_of_velocity_holds_whatever_the_weights_are():
    """½ ‖v' - v‖² at least; so nothing trembles for ever. The network says anything here."""
    simulator = SurrogateSimulator(cloth_of(), STEP, BackwardEuler(), 1)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        for parameter in simulator.surrogate.network.parameters():
            parameter.data.normal_(std=0.1)
    x = move(simulator, steps=60).positions[0]
    kinetic, total = energies(simulator.cloth, x)
    change = torch.diff(torch.diff(x, dim=0), dim=0) / STEP
    lost = 0.5 * (simulator.cloth.masses[:, None] * change.square()).sum((1, 2))
    assert (torch.diff(total) <= -lost + 1e-5 * kinetic.max()).all()


def test_only_ratios_of_mass_stiffness_and_force_matter():
    light = move(SurrogateSimulator(cloth_of(0.15), STEP, BDF2(), 1)).positions
    heavy = move(SurrogateSimulator(cloth_of(1.5), STEP, BDF2(), 1), scale=10.0).positions
    assert (light - heavy).abs().max() <= 1e-5


def test_the_residual_is_the_out_of_balance_force():
    coarse = move(SurrogateSimulator(cloth_of(), STEP, BDF2(), 1)).steps
    fine = move(SurrogateSimulator(cloth_of(), STEP, BDF2(), 8)).steps
    assert max(s.residual[0] for s in fine) < max(s.residual[0] for s in coarse)
    assert all(s.iterations == (0,) for s in fine)


@pytest.mark.parametrize(
    ("cloth", "message"),
    [
        (
            lambda: cloth_of(topology=Topology(144, cloth_of().topology.faces)),
            "a general mesh with stretching",
        ),
        (
            lambda: cloth_of(energies=InternalEnergy(cloth_of().energies.terms[:2])),
            "a grid with stretching, she",
        ),
        (lambda: grid_cloth((3, 9), (0.1, 0.3), 0.15, ()), "at least 4×4"),
        (lambda: cloth_of(masses=torch.linspace(1, 2, 144).double()), "uniform areal density"),
        (lambda: cloth_of(energies=skewed(cloth_of().energies)), "right angles"),
    ],
)
def test_cloth_that_it_does_not_know(cloth, message):
    with pytest.raises(ValueError, match=message):
        SurrogateSimulator(cloth(), STEP, BDF2(), 1)


def test_bad_settings(tmp_path):
    for settings, message in (((-1,), "passes"), ((1, 0), "sweeps")):
        with pytest.raises(ValueError, match=message):
            SurrogateSimulator(cloth_of(), STEP, BDF2(), *settings)
    with pytest.raises(InputError, match="no such file"):
        SurrogateSimulator(cloth_of(), STEP, BDF2(), 1, weights=tmp_path / "none.pt")
