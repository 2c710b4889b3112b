"""A cloth that hangs is stretched: its tension is found, and keeps it where it is."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from toile.diagnosis.base_fit import Base, base_sensitivities
from toile.diagnosis.effect_sensitivities import Instant, force_sensitivities
from toile.diagnosis.sensitivities import KnownMotion, LoadSensitivities, StepForces
from toile.diagnosis.template_tension import TemplateTension, template_tension
from toile.effects.base import Surroundings
from toile.effects.strain_stiffening import StrainStiffening
from toile.physics.cloth import Cloth, grid_cloth, grid_material
from toile.physics.implicit.integrators import BDF2, BackwardEuler
from toile.physics.implicit.newton import NewtonSettings
from toile.physics.implicit.simulator import ImplicitSimulator
from toile.physics.implicit.terms import changed_elements, term_forces
from toile.physics.rollout import rollout
from toile.physics.state import State
from toile.physics.step_terms import StepContext

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


def at_rest(cloth: Cloth, positions: np.ndarray) -> StepContext:
    """A step that begins at rest."""
    x, (y, s, b) = torch.from_numpy(positions), map(float, STIFFNESS)
    material = cloth.material(stretching=y, shearing=s, bending=b)
    return StepContext(cloth, material, x, 0 * x, STEP, STEP, x[cloth.pinned])


def test_stiffening_counts_from_the_unstretched_length(hanging) -> None:
    """Tension along the curve Y L₀ (ε + a ε³) from where the template is on it, not from its begin."""
    cloth, shape, true = hanging
    tension, a = TemplateTension(np.clip(true, 0, None)), 400.0
    lengths = cloth.rest_lengths.numpy()
    before = tension.tensions.numpy() / (STIFFNESS[0] * lengths)
    assert 0.01 < before.max() < 0.2
    for further in (0.0, 0.004, -0.003):
        now = at_rest(cloth, (1 + further) * shape)
        elements = changed_elements([StrainStiffening({"stretching": a}), tension], now)
        stiffness = STIFFNESS[0] * elements.factors["stretching"].numpy()
        found = stiffness * ((1 + further) * lengths - elements.rest["stretching"].numpy())
        after = before + further
        gained = STIFFNESS[0] * lengths * (after + a * after**3 - before - a * before**3)
        np.testing.assert_allclose(found, tension.tensions.numpy() + gained, rtol=1e-9, atol=1e-12)
    # With no further strain the load's tension stays; it is the stiffness that has grown, to the tangent's.
    at_template = changed_elements([StrainStiffening({"stretching": a}), tension], at_rest(cloth, shape))
    np.testing.assert_allclose(at_template.factors["stretching"], 1 + 3 * a * before**2, rtol=1e-9)


def test_a_stiffness_that_saturates_counts_from_the_unstretched_length(hanging) -> None:
    """Tension along the curve Y L₀ (ε + c ε³ / (ε² + ε_k²)) from where the template is on it."""
    cloth, shape, true = hanging
    tension, c, knee = TemplateTension(np.clip(true, 0, None)), 1.7, StrainStiffening.KNEES[0]
    effect = StrainStiffening().in_detail().with_values(torch.tensor([0.0, 0.0, c, 0.0]).double())
    lengths = cloth.rest_lengths.numpy()
    before = tension.tensions.numpy() / (STIFFNESS[0] * lengths)

    def curve(strain: np.ndarray) -> np.ndarray:
        return strain + c * strain**3 / (strain**2 + knee**2)

    for further in (0.0, 0.004, -0.003):
        elements = changed_elements([effect, tension], at_rest(cloth, (1 + further) * shape))
        stiffness = STIFFNESS[0] * elements.factors["stretching"].numpy()
        found = stiffness * ((1 + further) * lengths - elements.rest["stretching"].numpy())
        gained = STIFFNESS[0] * lengths * (curve(before + further) - curve(before))
        np.testing.assert_allclose(found, tension.tensions.numpy() + gained, rtol=1e-7, atol=1e-9)


def test_a_stiffening_cloth_stays_in_its_template(hanging) -> None:
    cloth, shape, _ = hanging
    tension = template_tension(cloth, shape, GRAVITY, HORIZONTAL)
    plain = np.abs(move(cloth, shape, STIFFNESS, 26, STEP, tension)[-1] - shape).max()
    stiffening = (StrainStiffening({"stretching": 2000.0}), tension)
    assert np.abs(move(cloth, shape, STIFFNESS, 26, STEP, *stiffening)[-1] - shape).max() < 1.2 * plain


def test_sensitivity_to_stiffening_is_that_of_the_simulated_force(hanging) -> None:
    cloth, shape, true = hanging
    tension = TemplateTension(np.clip(true, 0, None))
    moved = shape * 1.002
    now = at_rest(cloth, moved)
    still = np.zeros_like(moved)
    step = StepForces(0, moved, moved, still, np.zeros((3, *moved.shape)), still)
    around = Surroundings(cloth, SIZE, torch.from_numpy(GRAVITY), 1 / STEP, 2)

    def sensitivities(effect: StrainStiffening, *after: TemplateTension) -> np.ndarray:
        given = Instant(step, STEP, STEP, STIFFNESS, GRAVITY, moved[cloth.pinned.numpy()], after)
        return force_sensitivities(effect, given, around)

    effect = StrainStiffening({"stretching": 300.0, "shearing": 5.0}).in_detail()
    effect = effect.with_values(effect.values + torch.tensor([0.0, 0.0, 0.4, 0.3]).double())
    found = sensitivities(effect, tension)
    for k, scale in enumerate(effect.scales):
        change = torch.zeros(len(effect.scales), dtype=torch.float64)
        change[k] = 1e-4 * scale

        def force(values: torch.Tensor) -> np.ndarray:
            return term_forces([effect.with_values(values), tension], now, now.positions).detach().numpy()

        difference = (force(effect.values + change) - force(effect.values - change)) / 2e-4
        np.testing.assert_allclose(found[k], difference, atol=1e-6 * np.abs(difference).max())
    # From the template on, a cloth without tension would hardly have begun to stiffen.
    without = sensitivities(StrainStiffening())
    assert np.abs(found[0]).max() > 20 * np.abs(without[0]).max() > 0
