"""A cloth that hangs is stretched: its tension is found, and keeps it where it is."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from toile.diagnosis.base_fit import Base, base_sensitivities
from toile.diagnosis.sensitivities import KnownMotion, LoadSensitivities, StepForces
from toile.diagnosis.template_tension import TemplateTension, template_tension
from toile.physics.cloth import Cloth, grid_cloth, grid_material
from toile.physics.implicit.integrators import BDF2, BackwardEuler
from toile.physics.implicit.newton import NewtonSettings
from toile.physics.implicit.simulator import ImplicitSimulator
from toile.physics.rollout import rollout
from toile.physics.state import State

GRID, SIZE = (9, 8), (0.4, 0.35)
STIFFNESS = np.array([60.0, 2e-3, 2e-5])
GRAVITY = np.array([0.0, 9.81, 0.0])
HORIZONTAL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
STEP = 0.01


def move(
    cloth: Cloth, start: np.ndarray, stiffness: np.ndarray, frames: int, step: float, *terms
) -> np.ndarray:
    """Frames of a fall from rest, (F, N, 3); long steps bring to convergence."""
    method = BDF2() if step <= STEP else BackwardEuler()
    simulator = ImplicitSimulator(cloth, step, method, NewtonSettings(1e-9), terms)
    x = torch.from_numpy(start.copy())[None]
    state = State.start(x, torch.zeros_like(x), step, simulator.n_past)
    k = torch.from_numpy(stiffness)[:, None]
    force = (cloth.masses[:, None] * torch.from_numpy(GRAVITY)).expand(frames - 1, -1, 3)
    boundary = x[:, cloth.pinned].expand(frames, -1, -1)
    with torch.no_grad():
        motion = rollout(simulator, state, grid_material(k[0], k[1], k[2]), force[None], boundary[None], 1)
    return motion.positions[0].numpy()


@pytest.fixture(scope="module")
def hanging() -> tuple[Cloth, np.ndarray, np.ndarray]:
    """A cloth whose rest lengths are those that it hangs with, its shape, and its true tensions."""
    true = grid_cloth(GRID, SIZE, 0.15, (0, (GRID[0] - 1) * GRID[1]))
    i, j = torch.meshgrid(torch.arange(GRID[0]), torch.arange(GRID[1]), indexing="ij")
    flat = torch.stack((0.97 * i * 0.05, j * 0.05, 1 + 0.003 * torch.sin(1.1 * i + 0.4 * j)), -1)
    shape = move(true, flat.reshape(-1, 3).double().numpy(), STIFFNESS, 150, 0.2)[-1]
    edges = true.stencils.edges.numpy()
    lengths = np.linalg.norm(shape[edges[:, 1]] - shape[edges[:, 0]], axis=1)
    found = grid_cloth(GRID, SIZE, 0.15, (0, (GRID[0] - 1) * GRID[1]), torch.from_numpy(lengths))
    return found, shape, STIFFNESS[0] * (lengths - true.rest_lengths.numpy())


def test_the_tension_is_found_without_knowing_the_stiffness(hanging) -> None:
    cloth, shape, true = hanging
    found = template_tension(cloth, shape, GRAVITY, HORIZONTAL).tensions.numpy()
    assert found.min() >= 0
    assert np.corrcoef(found, true)[0, 1] > 0.95
    assert (found @ true) / (true @ true) == pytest.approx(1, abs=0.1)


def test_with_its_tension_a_hanging_cloth_stays_and_without_it_sags(hanging) -> None:
    cloth, shape, _ = hanging
    tension = template_tension(cloth, shape, GRAVITY, HORIZONTAL)
    sags = np.abs(move(cloth, shape, STIFFNESS, 26, STEP)[-1] - shape).max()
    stays = np.abs(move(cloth, shape, STIFFNESS, 26, STEP, tension)[-1] - shape).max()
    assert sags > 0.005
    assert stays < 0.2 * sags


def test_another_stiffness_leaves_the_tension_and_its_sensitivity_says_so(hanging) -> None:
    cloth, shape, true = hanging
    tension = TemplateTension(np.clip(true, 0, None))
    simulator = ImplicitSimulator(cloth, STEP, BDF2(), NewtonSettings(1e-9), (tension,))
    problem = SimpleNamespace(
        tension=tension, simulator=simulator, masses=cloth.masses.numpy(), horizontal=HORIZONTAL
    )
    frames = 9
    pulled = shape.copy()
    pulled[:, 1:] += 0.02 * (shape[:, 1:2] - shape[:, 1].min())
    motion = move(cloth, pulled, STIFFNESS, frames, STEP, tension)
    known = KnownMotion(simulator, motion, STIFFNESS)
    of_base = base_sensitivities(problem, Base(STIFFNESS, np.zeros(2)))
    pinned = np.zeros((5, len(cloth.pinned), 3))

    def loads(step: StepForces) -> LoadSensitivities:
        return LoadSensitivities(of_base(step), pinned)

    rest = np.zeros((5, len(shape), 3))
    tangents = np.stack([x for x, _ in known.tangents(0, frames - 1, 1, loads, rest, rest)])
    for k in range(3):
        factor = np.ones(3)
        factor[k] = np.exp(1e-4)
        ahead = move(cloth, pulled, STIFFNESS * factor, frames, STEP, tension)
        behind = move(cloth, pulled, STIFFNESS / factor, frames, STEP, tension)
        change = (ahead - behind)[1:] / 2e-4
        found = tangents[..., k].reshape(change.shape)
        assert np.linalg.norm(found - change) < 1e-3 * np.linalg.norm(change)


def test_a_strong_ridge_leaves_little_tension(hanging) -> None:
    cloth, shape, _ = hanging
    usual, small = (
        template_tension(cloth, shape, GRAVITY, HORIZONTAL, ridge).tensions.sum() for ridge in (0.003, 30.0)
    )
    assert 0 < small < 0.05 * usual
