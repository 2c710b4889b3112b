"""What stands in for causes that the catalogue lacks does what it says."""

from __future__ import annotations

import math

import pytest
import torch

from toile.effects.base import Surroundings
from toile.effects.pressure import Pressure
from toile.effects.rest_length_drift import RestLengthDrift
from toile.effects.steady_forces import SteadyForces
from toile.physics.cloth import grid_cloth, grid_material
from toile.physics.implicit.integrators import BackwardEuler
from toile.physics.implicit.newton import NewtonSettings
from toile.physics.implicit.simulator import ImplicitSimulator
from toile.physics.rollout import rollout
from toile.physics.state import State
from toile.physics.step_terms import StepContext

GRID, SIZE, STEP, STEPS = (7, 6), (0.3, 0.25), 0.02, 40
GRAVITY = torch.tensor([0.0, 9.81, 0.0], dtype=torch.float64)
CLOTH = grid_cloth(GRID, SIZE, 0.15, (0, GRID[1] - 1))
AROUND = Surroundings(CLOTH, SIZE, GRAVITY, 1 / STEP, STEPS + 1)


def start() -> torch.Tensor:
    """Hanging from two corners, grid axis 0 downwards."""
    i, j = torch.meshgrid(*(torch.linspace(0, s, n) for s, n in zip(SIZE, GRID, strict=True)), indexing="ij")
    return torch.stack((j, i, 0 * i), -1).reshape(1, -1, 3).double()


def moved(effect: RestLengthDrift, state: State | None, steps: int) -> tuple[torch.Tensor, State]:
    """Positions (steps + 1, N, 3) from a state on, and the last state."""
    simulator = ImplicitSimulator(CLOTH, STEP, BackwardEuler(), NewtonSettings(1e-11), (effect,))
    x = start()
    if state is None:
        state = State.start(x, torch.zeros_like(x), STEP, simulator.n_past)
    forces = (CLOTH.masses[:, None] * GRAVITY).expand(1, steps, -1, -1)
    boundary = x[:, CLOTH.pinned].expand(steps + 1, -1, -1)[None]
    material = grid_material(*(torch.tensor([k], dtype=torch.float64) for k in (400.0, 1e-3, 2e-5)))
    with torch.no_grad():
        motion = rollout(simulator, state, material, forces, boundary, 1)
    return motion.positions[0], motion.steps[-1].state


def shrinking(duration: float) -> RestLengthDrift:
    """By a tenth along axis 0 after ``duration``."""
    return RestLengthDrift({"axis_0_mean_1": -0.1}).for_clip(duration)


def test_sides_end_at_the_lengths_that_are_said() -> None:
    duration = STEPS * STEP
    plain, _ = moved(RestLengthDrift(), None, STEPS)
    shrunk, _ = moved(shrinking(duration), None, STEPS)
    height = shrunk[-1, :, 1].max() / plain[-1, :, 1].max()
    assert float(height) == pytest.approx(0.905, abs=0.02)  # exp(-0.1)
    along_0, along_1 = shrinking(duration).amounts(AROUND, {}, AROUND.frame_times())
    assert along_0 == ("axis 0", pytest.approx(100 * (2.718281828**-0.1 - 1)), "%")
    assert along_1 == ("axis 1", 0.0, "%")


def test_a_window_that_begins_later_knows_the_time_of_the_clip() -> None:
    """In windows of a clip drift goes on from where it is, and does not begin anew."""
    effect = shrinking(STEPS * STEP)
    whole, _ = moved(effect, None, STEPS)
    _, half = moved(effect, None, STEPS // 2)
    began = torch.tensor([STEPS // 2 * STEP], dtype=torch.float64)
    window = State(half.positions, half.velocities, half.past, 0, began)
    torch.testing.assert_close(moved(effect, window, STEPS // 2)[0], whole[STEPS // 2 :], atol=1e-9, rtol=0)
    anew = State(half.positions, half.velocities, half.past, 0, 0 * began)
    assert not torch.allclose(moved(effect, anew, STEPS // 2)[0], whole[STEPS // 2 :], atol=1e-4)


def test_steady_forces_leave_the_mean_to_the_wind() -> None:
    scales = SteadyForces().scales
    generator = torch.Generator().manual_seed(3)
    effect = SteadyForces().with_values(scales * torch.randn(len(scales), generator=generator).double())
    times = torch.linspace(0, 1, 5, dtype=torch.float64)
    field = effect.acceleration(times, AROUND)
    assert field.shape == (5, CLOTH.n_vertices, 3)
    torch.testing.assert_close(field, field[:1].expand_as(field))
    # Over the area: vertices at the border stand for half a cell.
    weights = torch.ones(GRID, dtype=torch.float64)
    weights[[0, -1]] *= 0.5
    weights[:, [0, -1]] *= 0.5
    mean = (weights.reshape(-1, 1) * field[0]).sum(0)
    torch.testing.assert_close(mean, torch.zeros(3, dtype=torch.float64), atol=1e-9, rtol=0)
    (size,) = effect.amounts(AROUND, {}, AROUND.frame_times())
    weights = weights.reshape(-1) / weights.sum()
    assert size.value == pytest.approx(float((weights @ field[0].square().sum(-1)).sqrt()))


class TestPressure:
    """Alike all over the cloth, along its normals, however fast gusts may be."""

    DURATION = STEPS * STEP

    def effect(self) -> Pressure:
        return Pressure({"wave_0": 0.8, "wave_3": -0.5}).for_clip(self.DURATION)

    def test_it_pushes_along_the_normals_as_hard_as_the_clock_says(self) -> None:
        sheet = start()[0]
        sheet[:, 2] = 0.05 * torch.sin(20 * sheet[:, 1])  # waves
        at = STEPS // 3 * STEP
        now = StepContext(
            CLOTH,
            grid_material(*(torch.ones(1).double() for _ in range(3))),
            sheet,
            0 * sheet,
            at,
            STEP,
            sheet[CLOTH.pinned],
        )
        ends = (
            sheet + 0.01 * torch.randn(sheet.shape, generator=torch.Generator().manual_seed(1)).double()
        ).requires_grad_()
        effect = self.effect()
        force = -torch.autograd.grad(effect.energy(ends, now).sum(), ends)[0]
        size = 0.8 - 0.5 * math.cos(3 * math.pi * at / self.DURATION)
        torch.testing.assert_close(force, size * CLOTH.masses[:, None] * now.normals)
        units = effect.force_derivatives(ends.detach(), now)
        torch.testing.assert_close(torch.einsum("k,kni->ni", effect.values, units), force)

    def test_longer_clips_have_more_waves_and_the_same_amplitudes(self) -> None:
        effect = self.effect()
        longer = effect.for_clip(3 * self.DURATION)
        assert len(effect.parameters) == 1 + math.ceil(6 * self.DURATION)
        assert len(longer.parameters) == 1 + math.ceil(6 * 3 * self.DURATION)
        assert float(longer.value("wave_0")) == 0.8
        assert float(longer.value("wave_3")) == -0.5
        assert int(longer.values.count_nonzero()) == 2

    def test_it_is_measured_per_mass_of_an_area(self) -> None:
        mean, deviation = self.effect().amounts(AROUND, {}, AROUND.frame_times())
        # Three half waves do not end at their mean over the frames of a clip, which hold both ends.
        waves = torch.cos(3 * torch.pi * AROUND.frame_times() / self.DURATION)
        assert mean.value == pytest.approx(float((0.8 - 0.5 * waves).mean()))
        assert deviation.value == pytest.approx(0.5 * float(waves.std(correction=0)))
