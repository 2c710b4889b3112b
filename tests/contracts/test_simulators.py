"""One suite over every simulator: what the interface promises, whatever computes the step."""

import dataclasses
from dataclasses import replace

import pytest
import torch

from toile.physics.cloth import grid_cloth, grid_material
from toile.physics.hybrid.simulator import HybridSimulator
from toile.physics.implicit.integrators import BDF2, BackwardEuler
from toile.physics.implicit.newton import NewtonSettings
from toile.physics.implicit.simulator import ImplicitSimulator
from toile.physics.rollout import rollout
from toile.physics.simulator import SimulationError, Simulator, StepResult, StepStatus
from toile.physics.state import State
from toile.physics.surrogate.gradients import Backpropagation, ImplicitFunction
from toile.physics.surrogate.simulator import SurrogateSimulator

GRID, SIZE, STEP = (5, 6), (0.2, 0.25), 1 / 60


class Extrapolation(Simulator):
    """The cheapest predictor: every vertex keeps its velocity."""

    def __init__(self, h, n_past):
        self.time_step, self.n_past = h, n_past

    def step(self, state, material, forces, boundary, guess=None, *, linearize=False):
        ahead = replace(state, positions=2 * state.positions - state.past[:, 0], steps=state.steps + 1)
        batch = len(state.positions)
        return StepResult(ahead, (StepStatus.CONVERGED,) * batch, (0,) * batch, (0.0,) * batch)


def hybrid(cloth, h, integrator):
    # From so poor a start the tolerance takes more corrections than from a good one.
    n_past = integrator.history - 1
    return HybridSimulator(cloth, h, integrator, lambda _, h: Extrapolation(h, n_past), 10, 1e-6)


# Another simulator is one more line: a name and what makes it from a cloth and a time step.
SIMULATORS = {
    "implicit, backward Euler": lambda cloth, h: ImplicitSimulator(
        cloth, h, BackwardEuler(), NewtonSettings()
    ),
    "implicit, BDF2": lambda cloth, h: ImplicitSimulator(cloth, h, BDF2(), NewtonSettings()),
    "hybrid, backward Euler": lambda cloth, h: hybrid(cloth, h, BackwardEuler()),
    "hybrid, BDF2": lambda cloth, h: hybrid(cloth, h, BDF2()),
    "surrogate, backward Euler": lambda cloth, h: SurrogateSimulator(cloth, h, BackwardEuler(), 2),
    "surrogate, BDF2": lambda cloth, h: SurrogateSimulator(cloth, h, BDF2(), 2),
    "surrogate, backpropagation": lambda cloth, h: SurrogateSimulator(
        cloth, h, BDF2(), 2, gradient=Backpropagation()
    ),
}


@pytest.fixture(params=SIMULATORS)
def make(request):
    def simulator(pinned=(0, 5), h=STEP):
        return SIMULATORS[request.param](grid_cloth(GRID, SIZE, 0.2, pinned), h)

    return simulator


def cloth_of(simulator):
    return simulator.cloth


def flat(batch=1):
    i, j = torch.meshgrid(
        torch.linspace(0, SIZE[0], GRID[0], dtype=torch.float64),
        torch.linspace(0, SIZE[1], GRID[1], dtype=torch.float64),
        indexing="ij",
    )
    return torch.stack((j, i, torch.ones_like(i)), -1).reshape(1, -1, 3).repeat(batch, 1, 1)


def scene(simulator, frames=4, seeds=(0,)):
    """Different bent cloths, materials, forces and boundary position motions, one per seed."""
    cloth = cloth_of(simulator)
    parts = []
    for seed in seeds:
        generator = torch.Generator().manual_seed(seed)
        x = flat()
        x[..., 2] += 0.01 * torch.sin(20 * x[..., 0] + (5 + seed) * x[..., 1])
        noise = torch.randn(1, frames - 1, 30, 3, generator=generator, dtype=torch.float64)
        forces = cloth.masses[:, None] * (torch.tensor([0.0, 9.81, 0.0]).double() + noise)
        path = torch.randn(1, frames, len(cloth.pinned), 3, generator=generator, dtype=torch.float64).cumsum(
            1
        )
        boundary = x[:, None, cloth.pinned] + 0.002 * path
        stiffness = torch.tensor([60.0, 3e-4, 2e-5], dtype=torch.float64) * (1 + 0.3 * seed)
        velocities = 0.05 * torch.randn(1, 30, 3, generator=generator, dtype=torch.float64)
        parts.append((x, velocities, stiffness[None], forces, boundary))
    x, velocities, stiffness, forces, boundary = (torch.cat(p) for p in zip(*parts, strict=True))
    state = State.start(x, velocities, simulator.time_step, simulator.n_past)
    return state, grid_material(*stiffness.unbind(-1)), forces, boundary


def test_step_result_has_one_entry_per_scene(make):
    simulator = make()
    state, material, forces, boundary = scene(simulator, seeds=(0, 1, 2))
    result = simulator.step(state, material, forces[:, 0], boundary[:, 1])
    assert result.status == (StepStatus.CONVERGED,) * 3
    assert len(result.iterations) == len(result.residual) == 3
    new = result.state
    assert new.positions.shape == new.velocities.shape == (3, 30, 3)
    assert new.past.shape == (3, simulator.n_past, 30, 3)
    assert new.steps == 1
    if simulator.n_past:
        assert torch.equal(new.past[:, 0], state.positions)


def test_inputs_are_left_alone(make):
    simulator = make()
    state, material, forces, boundary = scene(simulator)
    guess = state.positions + 0.001
    given = [state.positions, state.velocities, state.past, forces, boundary, guess]
    kept = [t.clone() for t in given]
    simulator.step(state, material, forces[:, 0], boundary[:, 1], guess)
    for tensor, before in zip(given, kept, strict=True):
        assert torch.equal(tensor, before)


def test_flat_cloth_at_rest_stays_at_rest(make):
    simulator = make()
    state = State.start(flat(), torch.zeros(1, 30, 3).double(), STEP, simulator.n_past)
    _, material, forces, _ = scene(simulator)
    boundary = flat()[:, None, cloth_of(simulator).pinned].expand(1, 4, -1, -1)
    motion = rollout(simulator, state, material, 0 * forces, boundary, 1)
    assert (motion.positions - flat()[:, None]).abs().max() <= 1e-12


def test_cloth_falls_along_gravity(make):
    simulator = make(pinned=())
    state = State.start(flat(), torch.zeros(1, 30, 3).double(), STEP, simulator.n_past)
    _, material, _, _ = scene(simulator)
    g = torch.tensor([0.0, 9.81, 0.0], dtype=torch.float64)
    forces = (cloth_of(simulator).masses[:, None] * g).expand(1, 12, -1, 3)
    motion = rollout(simulator, state, material, forces, torch.zeros(1, 13, 0, 3).double(), 1)
    fall = motion.positions[:, -1] - flat()
    exact = 0.5 * 9.81 * (12 * STEP) ** 2
    # first order in the step at worst: h g t / 2
    assert (fall[..., 1] - exact).abs().max() <= 0.5 * STEP * 9.81 * 12 * STEP * 1.01
    assert fall[..., [0, 2]].abs().max() <= 1e-9


def test_pinned_vertices_are_at_their_boundary_positions(make):
    simulator = make()
    state, material, forces, boundary = scene(simulator)
    motion = rollout(simulator, state, material, forces, boundary, 2)
    assert torch.equal(motion.positions[:, 1:, cloth_of(simulator).pinned], boundary[:, 1:])


def test_a_batch_is_its_scenes_one_by_one(make):
    simulator = make()
    state, material, forces, boundary = scene(simulator, seeds=(0, 1))
    both = rollout(simulator, state, material, forces, boundary, 2).all_positions
    for b in range(2):
        alone = rollout(simulator, *scene(simulator, seeds=(b,)), 2).all_positions
        if isinstance(simulator, SurrogateSimulator):
            # Convolutions round differently in batches of another size; worst seen 1e-7.
            assert (both[b : b + 1] - alone).abs().max() <= 1e-6
        else:
            assert torch.equal(both[b : b + 1], alone)


def test_repeated_runs_are_bit_identical(make):
    runs = [rollout(s, *scene(s), 1).positions for s in (make(), make())]
    assert torch.equal(*runs)


def test_a_rollout_continues_where_another_stopped(make):
    simulator = make()
    state, material, forces, boundary = scene(simulator, frames=6)
    whole = rollout(simulator, state, material, forces, boundary, 1)
    first = rollout(simulator, state, material, forces[:, :2], boundary[:, :3], 1)
    second = rollout(simulator, first.steps[-1].state, material, forces[:, 2:], boundary[:, 2:], 1)
    assert torch.equal(torch.cat((first.positions, second.positions[:, 1:]), 1), whole.positions)


def test_rollout_keeps_every_substep_and_returns_frames(make):
    simulator = make()
    state, material, forces, boundary = scene(simulator, frames=4)
    motion = rollout(simulator, state, material, forces, boundary, 3)
    assert motion.positions.shape == (1, 4, 30, 3)
    assert motion.all_positions.shape == (1, 10, 30, 3)
    assert torch.equal(motion.all_positions[:, ::3], motion.positions)
    assert len(motion.steps) == 9


def test_gradient_of_a_rollout_along_a_random_direction(make):
    """Directional derivative with respect to all inputs at once against a central difference."""
    simulator = make()
    state, material, forces, boundary = scene(simulator)
    inputs = {
        "x": state.positions,
        "v": state.velocities,
        "Y": material["stretching"],
        "S": material["shearing"],
        "B": material["bending"],
        "f": forces,
        "a": boundary,
    }
    scales = {"x": 1e-3, "v": 0.1, "Y": 60.0, "S": 3e-4, "B": 2e-5, "f": 1e-3, "a": 1e-3}
    generator = torch.Generator().manual_seed(9)
    along = {
        k: scales[k] * torch.randn(v.shape, generator=generator, dtype=v.dtype) for k, v in inputs.items()
    }
    weights = torch.randn(1, 4, 30, 3, generator=generator, dtype=torch.float64)

    def loss(given):
        start = State.start(given["x"], given["v"], simulator.time_step, simulator.n_past)
        motion = rollout(
            simulator, start, grid_material(given["Y"], given["S"], given["B"]), given["f"], given["a"], 1
        )
        return (weights * motion.positions).sum()

    leaves = {k: v.clone().requires_grad_() for k, v in inputs.items()}
    gradients = torch.autograd.grad(loss(leaves), tuple(leaves.values()))
    assert all(g.abs().max() > 0 for g in gradients)
    slope = sum(float((g * along[k]).sum()) for k, g in zip(inputs, gradients, strict=True))
    eps = 1e-3
    ahead, behind = (loss({k: v + s * eps * along[k] for k, v in inputs.items()}) for s in (1, -1))
    assert slope == pytest.approx(float((ahead - behind) / (2 * eps)), rel=tolerance_of(simulator))


def tolerance_of(simulator):
    """Of a derivative against a finite difference; worst seen of the solver 1.3e-5."""
    if not isinstance(simulator, SurrogateSimulator):
        return 1e-4
    # Either those of the minimum that the network comes close to, or its own in single precision.
    return 0.2 if isinstance(simulator.gradient, ImplicitFunction) else 0.005


@pytest.mark.parametrize("name", ["positions", "past", "forces", "boundary", "material", "guess"])
def test_wrong_shapes_are_told(make, name):
    simulator = make()
    state, material, forces, boundary = scene(simulator)
    forces, boundary, guess = forces[:, 0], boundary[:, 1], None
    if name == "positions":
        state = dataclasses.replace(state, positions=state.positions[:, :-1])
    elif name == "past":
        state = dataclasses.replace(state, past=torch.cat((state.past, state.past), 1))
    elif name == "forces":
        forces = forces[:, :1]  # would broadcast
    elif name == "boundary":
        boundary = boundary[:, :1]  # would broadcast
    elif name == "material":
        material = dataclasses.replace(material, values=material.values.repeat(2, 1))
    else:
        guess = state.positions[:, :3]
    with pytest.raises(ValueError, match=rf"{name}: expected .* got "):
        simulator.step(state, material, forces, boundary, guess)


def test_frames_of_forces_and_boundary_must_agree(make):
    simulator = make()
    state, material, forces, boundary = scene(simulator, frames=4)
    with pytest.raises(
        ValueError, match="boundary positions: expected 3 frames as given by the forces, got 4"
    ):
        rollout(simulator, state, material, forces[:, :2], boundary, 1)


def test_not_a_number_is_an_error(make):
    simulator = make()
    state, material, forces, boundary = scene(simulator, seeds=(0, 1))
    forces[1, 1, 12, 0] = torch.nan
    with pytest.raises(SimulationError, match=r"frame 2, .* scene 1 of the batch: .*not finite"):
        rollout(simulator, state, material, forces, boundary, 1)
