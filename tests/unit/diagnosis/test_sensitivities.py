"""Tangents for many unknowns at once against the simulation itself."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from toile.diagnosis.effect_sensitivities import FORCES, Instant, force_sensitivities
from toile.diagnosis.sensitivities import (
    DEFAULT,
    BlockFactor,
    KnownMotion,
    LoadSensitivities,
    StepForces,
    TangentSettings,
)
from toile.effects.base import Effect, Surroundings
from toile.effects.catalogue import CATALOGUE, STAND_INS
from toile.effects.setting import setting
from toile.physics.cloth import grid_cloth
from toile.physics.grid_laws import GridLaw, angles, taut
from toile.physics.grid_lines import GridLines
from toile.physics.implicit.integrators import BDF2
from toile.physics.implicit.linear_solvers.banded import BandedCholesky
from toile.physics.implicit.newton import NewtonSettings
from toile.physics.implicit.simulator import ImplicitSimulator
from toile.physics.material import Material
from toile.physics.rollout import rollout
from toile.physics.state import State

GRID = (6, 7)
STEP = 0.01
N_FRAMES = 9
STIFFNESS = {
    "stretching": 400.0,
    "edge_compression": 0.5,
    "shearing": 1e-3,
    "diagonal_compression": 0.2,
    "bending": 2e-5,
}
GRAVITY = torch.tensor([0.0, 9.81, 0.0], dtype=torch.float64)
WIND = torch.tensor([1.0, 0.0, 4.0], dtype=torch.float64)


EFFECTS = {**CATALOGUE, **STAND_INS}
THROUGH_FORCES = [n for n, e in EFFECTS.items() if issubclass(e, FORCES) and n != "contact"]


def surroundings(crowding: float = 0.0, law: GridLaw = angles) -> Surroundings:
    lines = GridLines.crowded(*GRID, crowding)
    cloth = grid_cloth(GRID, (0.3, 0.36), 0.15, (0, (GRID[0] - 1) * GRID[1]), law=law, lines=lines)
    return Surroundings(cloth, (0.3, 0.36), GRAVITY, 1 / STEP, N_FRAMES)


def stiffness(around: Surroundings) -> np.ndarray:
    return np.array([STIFFNESS[name] for name in around.cloth.energies.parameters.names])


def start(around: Surroundings) -> torch.Tensor:
    u, v = around.cloth.lines.places()
    i, j = torch.meshgrid((GRID[0] - 1) * u, (GRID[1] - 1) * v, indexing="ij")
    x = torch.stack((i * 0.06 * 0.98, j * 0.06, 1 + 0.01 * torch.sin(1.0 * i) + 0.004 * j), -1)
    return x.reshape(1, -1, 3).to(torch.float64)


UNLIMITED = TangentSettings(fastest=1e12)
"""Tangents as they are, however fast changes grow."""


def simulate(effects, around: Surroundings) -> np.ndarray:
    x0 = start(around)
    pinned = around.cloth.pinned
    times = around.frame_times()
    boundary = x0[:, pinned] + 0.02 * torch.sin(20 * times)[:, None, None] * torch.tensor([0.0, 0.3, 1.0])
    given = setting(effects, around, boundary[:, :].reshape(N_FRAMES, len(pinned), 3), WIND)
    step = float(given.frame_interval)
    simulator = ImplicitSimulator(given.cloth, step, BDF2(), NewtonSettings(1e-10), given.terms)
    parameters = around.cloth.energies.parameters
    material = Material(parameters, torch.from_numpy(stiffness(around))[None])
    state = State.start(x0, torch.zeros_like(x0), step, simulator.n_past)
    with torch.no_grad():
        motion = rollout(simulator, state, material, given.forces[None], given.boundary[None], 1)
    return motion.positions[0].numpy()


def test_blocks_solve_what_the_band_solves() -> None:
    rng = np.random.default_rng(0)
    n, width = 53, 11
    dense = np.zeros((n, n))
    for k in range(width + 1):
        values = rng.normal(size=n - k)
        dense += np.diag(values, -k) + (np.diag(values, k) if k else 0)
    dense += 30 * np.eye(n)
    band = np.zeros((n, width + 1))
    for k in range(width + 1):
        band[: n - k, k] = np.diag(dense, -k)
    factor = BandedCholesky.factorise(band)
    assert factor is not None
    right = rng.normal(size=(n, 5)).astype(np.float32)
    np.testing.assert_allclose(BlockFactor(factor).solve(right), np.linalg.solve(dense, right), atol=1e-6)


def effect_tangents(
    effect: Effect, simulator: ImplicitSimulator, motion: np.ndarray, around: Surroundings
) -> np.ndarray:
    """Change of the frames after the first by every number of an effect (n, F-1, N, 3)."""
    pinned = around.cloth.pinned.numpy()
    acceleration = (GRAVITY + WIND).numpy()
    h, n = simulator.time_step, len(effect.scales)
    rest = np.zeros((n, len(motion[0]), 3))

    def loads(step: StepForces) -> LoadSensitivities:
        end, boundary = (step.index + 1) * h, step.positions[pinned]
        held = float(around.held_times()[step.index])
        now = Instant(step, end, h, stiffness(around), acceleration, boundary, held=held)
        return LoadSensitivities(force_sensitivities(effect, now, around), np.zeros((n, len(pinned), 3)))

    known = KnownMotion(simulator, motion, stiffness(around), settings=UNLIMITED)
    tangents = known.tangents(0, N_FRAMES - 1, 1, loads, rest, rest)
    found = np.stack([x for x, _ in tangents])
    return np.moveaxis(found, -1, 0).reshape(n, *motion[1:].shape)


@pytest.mark.parametrize("law", [angles, taut])
@pytest.mark.parametrize("name", THROUGH_FORCES)
def test_tangents_are_the_derivatives_of_the_simulation(name: str, law: GridLaw) -> None:
    """To first order: what effects do to later velocities through themselves is of second order here."""
    around = surroundings(law=law)
    effect = EFFECTS[name]()
    plain = simulate((), around)
    simulator = ImplicitSimulator(around.cloth, STEP, BDF2(), NewtonSettings(1e-10))
    tangents = effect_tangents(effect, simulator, plain, around)
    for k in range(len(effect.scales)):
        small = torch.zeros_like(effect.scales)
        small[k] = 1e-4 * effect.scales[k]
        change = (simulate((effect.with_values(small),), around) - plain)[1:] / 1e-4
        found = tangents[k]
        for frame in (3, N_FRAMES - 2):
            error = np.linalg.norm(found[frame] - change[frame]) / max(np.linalg.norm(change[frame]), 1e-12)
            assert error < 0.06, (effect.parameters[k].name, frame, error)


def test_the_required_force_is_the_one_that_acted() -> None:
    around = surroundings()
    motion = KnownMotion(
        ImplicitSimulator(around.cloth, STEP, BDF2(), NewtonSettings(1e-10)),
        simulate((), around),
        stiffness(around),
    )
    acted = (around.cloth.masses[:, None] * (GRAVITY + WIND)).numpy()
    acted[around.cloth.pinned.numpy()] = 0
    for n in range(N_FRAMES - 1):
        np.testing.assert_allclose(motion.required(motion.step(n)), acted, atol=1e-8)


@pytest.mark.parametrize("crowding", [0.0, 0.5])
@pytest.mark.parametrize("name", THROUGH_FORCES)
def test_tangents_hold_where_an_effect_is_strong(name: str, crowding: float) -> None:
    """What damping, drag and changed stiffness do to later motion is in the tangents, not in the forces."""
    _expect_tangents(name, surroundings(crowding))


@pytest.mark.parametrize("name", ["internal_damping", "strain_stiffening", "rest_length_drift"])
def test_tangents_hold_where_springs_hardly_push(name: str) -> None:
    """Where threads pull and hardly push, what they remember of the past hangs on which of both they do."""
    _expect_tangents(name, surroundings(law=taut))


def _expect_tangents(name: str, around: Surroundings) -> None:
    plain_effect = EFFECTS[name]()
    numbers = 0.8 * plain_effect.scales
    effect = plain_effect.with_values(numbers)
    motion = simulate((effect,), around)
    given = setting((effect,), around, torch.zeros(N_FRAMES, len(around.cloth.pinned), 3).double())
    step = float(given.frame_interval)
    simulator = ImplicitSimulator(given.cloth, step, BDF2(), NewtonSettings(1e-10), given.terms)
    tangents = effect_tangents(effect, simulator, motion, around)
    for k in range(len(effect.scales)):
        small = torch.zeros_like(effect.scales)
        small[k] = 1e-4 * effect.scales[k]
        ahead, behind = (simulate((effect.with_values(numbers + s),), around) for s in (small, -small))
        change = (ahead - behind)[1:] / 2e-4
        error = np.linalg.norm(tangents[k] - change) / max(np.linalg.norm(change), 1e-12)
        assert error < 1e-4, (effect.parameters[k].name, error)


def growth(scale: float, settings: TangentSettings) -> float:
    """Fastest growth of a change in one step of a cloth whose start is scaled by a factor."""
    around = surroundings()
    x = scale * start(around)[0].numpy()
    simulator = ImplicitSimulator(around.cloth, STEP, BDF2(), NewtonSettings(1e-10))
    motion = KnownMotion(simulator, np.stack((x, x)), stiffness(around), settings=settings)
    motion.step(0)
    _, inertia = motion.coefficients(0)
    factor, _ = motion._factor(x, inertia)
    place = np.argsort(motion._solver.order)
    weight = np.sqrt(np.repeat(inertia, 3))[place]
    free = simulator.assembly.free.reshape(-1)[place] > 0
    inverse = factor.solve(np.eye(factor.n, dtype=np.float32))
    scaled = (weight[:, None] * inverse * weight)[np.ix_(free, free)]
    return float(np.linalg.eigvalsh(0.5 * (scaled + scaled.T)).max())


def test_no_change_grows_faster_than_is_followed() -> None:
    """Between slack and taut a cloth is about to buckle, and its tangents would be without bounds."""
    scales = np.linspace(1.0, 1.02, 21)
    for settings in (DEFAULT, TangentSettings(fastest=3.0)):
        assert max(growth(scale, settings) for scale in scales) < 1.02 * settings.fastest
    assert max(growth(scale, UNLIMITED) for scale in scales) > 2 * DEFAULT.fastest
