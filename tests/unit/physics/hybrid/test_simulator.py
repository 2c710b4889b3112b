"""The hybrid simulator: what corrections do, when a step counts as done, where derivatives come from."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from toile.physics.cloth import grid_cloth, grid_material
from toile.physics.hybrid.simulator import HybridSimulator
from toile.physics.implicit import newton
from toile.physics.implicit.integrators import BDF2, BackwardEuler
from toile.physics.implicit.linearized import LinearizedRollout, Perturbation
from toile.physics.implicit.newton import NewtonSettings
from toile.physics.implicit.simulator import ImplicitSimulator
from toile.physics.rollout import rollout
from toile.physics.simulator import Simulator, StepResult, StepStatus
from toile.physics.state import State

GRID, SIDE, STEP, FRAMES = (6, 6), 0.25, 1 / 60, 7
CLOTH = grid_cloth(GRID, (SIDE, SIDE), 0.2, (0, 5))
FORCE = float(CLOTH.masses.max()) * 9.81  # weight of an interior vertex [N]
MATERIAL = grid_material(*torch.tensor([[60.0], [3e-4], [1e-4]], dtype=torch.float64))


class CountingAssembly:
    """Counts Hessians, passes everything on."""

    def __init__(self, assembly):
        self._assembly = assembly
        self.hessians = []

    def __getattr__(self, name):
        return getattr(self._assembly, name)

    def hessian(self, x, stiffness, *, convex):
        self.hessians.append(x.copy())
        return self._assembly.hessian(x, stiffness, convex=convex)


class Near(Simulator):
    """The exact minimiser plus a share of the error of standing still."""

    def __init__(self, share, integrator=None):
        self.share = share
        self.exact = ImplicitSimulator(CLOTH, STEP, integrator or BDF2(), NewtonSettings(tolerance=1e-9))
        self.time_step, self.n_past = STEP, self.exact.n_past

    def step(self, state, material, forces, boundary, guess=None, *, linearize=False):
        found = self.exact.step(state, material, forces, boundary)
        positions = found.state.positions + self.share * (state.positions - found.state.positions)
        after = replace(found.state, positions=positions)
        return StepResult(after, found.status, found.iterations, found.residual)


def hybrid(share, **settings):
    return HybridSimulator(CLOTH, STEP, BDF2(), lambda cloth, h: Near(share), **settings)


def scene(simulator):
    i, j = torch.meshgrid(*[torch.linspace(0, SIDE, 6, dtype=torch.float64)] * 2, indexing="ij")
    x = torch.stack((j, i, 1 + 0.01 * torch.sin(20 * j + 9 * i)), -1).reshape(1, -1, 3)
    state = State.start(x, torch.zeros_like(x), STEP, simulator.n_past)
    swing = torch.tensor([1.0, 9.81, 3.0]).double() * CLOTH.masses[:, None]
    boundary = x[:, None, CLOTH.pinned].repeat(1, FRAMES, 1, 1)
    return state, MATERIAL, swing.expand(1, FRAMES - 1, -1, 3).contiguous(), boundary


def step(simulator, **more):
    state, material, forces, boundary = scene(simulator)
    return simulator.step(state, material, forces[:, 0], boundary[:, 1], **more)


def test_one_correction_squares_the_predictors_error(monkeypatch):
    monkeypatch.setattr(newton, "_REUSE_RATIO", 0.0)  # each factor once
    left = [step(hybrid(share, corrections=1, tolerance=1e-12)).residual[0] for share in (0.2, 0.1, 0.05)]
    rates = np.log2(np.array(left[:-1]) / left[1:])
    np.testing.assert_allclose(rates, 2.0, atol=0.25)  # measured 1.94, 1.97


def test_every_correction_helps():
    steps = [step(hybrid(1.0, corrections=n, tolerance=1e-9)) for n in range(3)]
    assert [s.iterations for s in steps] == [(0,), (1,), (2,)]
    assert all(s.status == (StepStatus.CONVERGED,) for s in steps)
    left = [s.residual[0] / FORCE for s in steps]
    assert left[0] > 50 * left[1]  # measured 11 weights, 0.08, 6e-13
    assert left[2] <= 1e-9


def test_without_corrections_the_prediction_is_the_step():
    simulator = hybrid(0.1, corrections=0)
    state, material, forces, boundary = scene(simulator)
    predicted = simulator.predictor.step(state, material, forces[:, 0], boundary[:, 1])
    found = step(simulator)
    assert torch.equal(found.state.positions, predicted.state.positions)
    assert found.iterations == (0,)


def test_a_start_within_the_tolerance_costs_no_hessian():
    simulator = hybrid(0.0)
    simulator.assembly = CountingAssembly(simulator.assembly)
    assert step(simulator).iterations == (0,)
    assert simulator.assembly.hessians == []


def test_what_is_left_fails_a_step_only_above_the_largest_residual():
    settings = {"corrections": 1, "tolerance": 1e-9}  # leaves 0.08 weights
    assert step(hybrid(1.0, **settings, largest_residual=0.2)).status == (StepStatus.CONVERGED,)
    assert step(hybrid(1.0, **settings, largest_residual=0.01)).status == (StepStatus.MAX_ITERATIONS,)


def test_a_predictor_that_fails_is_passed_over():
    simulator = hybrid(torch.nan, corrections=4)
    exact = step(ImplicitSimulator(CLOTH, STEP, BDF2(), NewtonSettings()))
    found = step(simulator)
    assert found.status == (StepStatus.CONVERGED,)
    assert (found.state.positions - exact.state.positions).abs().max() <= 1e-5 * SIDE


def test_a_guess_is_ignored():
    """A motion follows from its past and its forces alone, also where the corrections run out."""
    exact = step(ImplicitSimulator(CLOTH, STEP, BDF2(), NewtonSettings())).state.positions
    without, with_guess = step(hybrid(0.5)), step(hybrid(0.5), guess=exact)
    assert torch.equal(without.state.positions, with_guess.state.positions)


def test_forces_that_are_not_finite_are_told():
    simulator = hybrid(0.1)
    state, material, forces, boundary = scene(simulator)
    forces = forces.clone()
    forces[0, 0, 20] = torch.nan
    assert simulator.step(state, material, forces[:, 0], boundary[:, 1]).status == (StepStatus.NOT_FINITE,)


@pytest.mark.parametrize("fresh", [True, False])
def test_linearization_is_that_of_the_positions_or_of_the_last_correction(fresh):
    simulator = hybrid(0.1, fresh_linearization=fresh)
    simulator.assembly = CountingAssembly(simulator.assembly)
    found = step(simulator, linearize=True)
    assert found.iterations == (1,)
    hessians = simulator.assembly.hessians
    assert len(hessians) == (2 if fresh else 1)
    assert np.array_equal(hessians[-1], found.state.positions[0].numpy()) is fresh
    kept = found.linearization[0]
    assert kept.exact is fresh
    gradients = simulator.assembly.gradients(found.state.positions[0].numpy())
    np.testing.assert_array_equal(kept.unit_gradients, gradients)
    stiffness = np.array(
        [float(k) for k in (MATERIAL["stretching"], MATERIAL["shearing"], MATERIAL["bending"])]
    )
    inertia = CLOTH.masses.numpy() / STEP**2  # of the first step
    there = newton.linearise(
        simulator.assembly, simulator.solver, hessians[-1], gradients, stiffness, inertia
    )
    np.testing.assert_array_equal(kept.factor.cholesky.band, there.factor.cholesky.band)
    np.testing.assert_array_equal(kept.coupling, there.coupling)


def test_a_start_within_the_tolerance_is_linearised_afresh():
    kept = step(hybrid(0.0, fresh_linearization=False), linearize=True).linearization[0]
    assert kept.exact


def test_tangents_are_as_good_as_the_positions():
    """Chained over all steps: fresh linearisations are exact, reused ones a few per cent off."""
    rng = np.random.default_rng(0)
    still = np.zeros((CLOTH.n_vertices, 3))
    change = Perturbation(
        rng.normal(size=(FRAMES - 1, CLOTH.n_vertices, 3)) * 1e-3,
        np.array([6.0, 3e-5, 1e-5]),
        np.zeros((FRAMES, 2, 3)),
        still,
        still,
    )

    def tangent(simulator):
        return LinearizedRollout(simulator, rollout(simulator, *scene(simulator), 1, linearize=True)).tangent(
            change
        )

    exact = tangent(ImplicitSimulator(CLOTH, STEP, BDF2(), NewtonSettings(tolerance=1e-9)))

    def error(fresh):
        found = tangent(hybrid(0.05, fresh_linearization=fresh))
        return np.linalg.norm(found - exact) / np.linalg.norm(exact)

    assert error(True) <= 1e-4  # measured 5e-6
    assert 1e-3 <= error(False) <= 0.2  # measured 0.018


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"corrections": -1}, "corrections: expected 0 or more, got -1"),
        ({"largest_residual": 0.0}, "largest_residual: expected a positive number or None, got 0.0"),
    ],
)
def test_wrong_settings_are_told(settings, message):
    with pytest.raises(ValueError, match=message):
        hybrid(0.1, **settings)


def test_a_predictor_with_another_past_is_told():
    with pytest.raises(ValueError, match=r"predictor: expected one that keeps 3 past positions .* got 1"):
        HybridSimulator(CLOTH, STEP, BDF2(), lambda cloth, h: Near(0.1, BackwardEuler()))
