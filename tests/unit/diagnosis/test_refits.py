"""Hypotheses at their own best fit: what is there grows, what only seemed to be there goes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from toile.diagnosis.base_fit import BaseFit, base_deviations, base_of, fit_base, improved, n_base
from toile.diagnosis.continuity import Discrepancy
from toile.diagnosis.effect_size import effect_size
from toile.diagnosis.evidence import Evidence
from toile.diagnosis.findings import mechanical_findings
from toile.diagnosis.mechanics import Mechanics, effect_systems
from toile.diagnosis.refits import Refit, RefitSettings, converged, refits
from toile.diagnosis.shooting import Shooting, ShootingSettings
from toile.diagnosis.tracked import Tracked
from toile.effects.base import Surroundings
from toile.effects.catalogue import CATALOGUE
from toile.effects.setting import setting
from toile.physics.cloth import grid_cloth, grid_material
from toile.physics.implicit.integrators import BDF2
from toile.physics.implicit.newton import NewtonSettings
from toile.physics.implicit.simulator import ImplicitSimulator
from toile.physics.rollout import rollout
from toile.physics.state import State

GRID = (7, 7)
FRAMES, FPS, SUBSTEPS = 17, 25.0, 4
STIFFNESS = np.array([400.0, 2e-3, 1e-4])
GRAVITY = np.array([0.0, 9.81, 0.0])
HORIZONTAL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
USUAL = Discrepancy(0.4, 0.1)
TRUE = {"bending": -3.0, "stretching": 0.0}
NAMES = ("anisotropic_stiffness", "frame_rate", "air_drag")


@pytest.fixture(scope="module")
def mechanics() -> Mechanics:
    """A cloth far stiffer against bending one way than the other swings down; its motion is known."""
    cloth = grid_cloth(GRID, (0.3, 0.3), 0.15, (0, (GRID[0] - 1) * GRID[1]))
    around = Surroundings(cloth, (0.3, 0.3), torch.from_numpy(GRAVITY), FPS, FRAMES)
    i, j = torch.meshgrid(torch.arange(GRID[0]), torch.arange(GRID[1]), indexing="ij")
    depth = 1 + 0.6 * j * 0.05 + 0.01 * torch.sin(1.1 * i)
    start = torch.stack((0.94 * i * 0.05, 0.8 * j * 0.05, depth), -1).reshape(1, -1, 3).double()
    boundary = start[:, cloth.pinned].expand(FRAMES, -1, -1)
    effect = CATALOGUE["anisotropic_stiffness"]()
    effect = effect.with_values(torch.tensor([TRUE[p.name] for p in effect.parameters], dtype=torch.float64))
    given = setting((effect,), around, boundary)
    h = 1 / FPS / SUBSTEPS
    real = ImplicitSimulator(given.cloth, h, BDF2(), NewtonSettings(1e-8), given.terms)
    k = torch.from_numpy(STIFFNESS)[:, None]
    state = State.start(start, torch.zeros_like(start), h, real.n_past)
    with torch.no_grad():
        motion = rollout(
            real, state, grid_material(k[0], k[1], k[2]), given.forces[None], given.boundary[None], SUBSTEPS
        )
    positions = motion.positions[0].numpy()
    n = 3 * positions.shape[1]
    seen = [np.eye(n, dtype=np.float32) / 0.002**2] * FRAMES
    tracked = Tracked(positions, seen, np.zeros_like(positions), positions)
    model = ImplicitSimulator(cloth, h, BDF2(), NewtonSettings(1e-3))
    settings = ShootingSettings(modes=2, likelihood_weight=1.0)
    shooting = Shooting(
        model, SUBSTEPS, GRAVITY, HORIZONTAL, GRID, positions[:, cloth.pinned.numpy()], tracked, settings
    )
    fit = fit_base(shooting, positions[0], STIFFNESS, FRAMES, lambda what, cost: None)
    effects = [CATALOGUE[name]() for name in NAMES]
    coefficients, at = {}, 0
    for candidate in effects:
        coefficients[candidate.NAME] = (at, at + len(candidate.scales))
        at += len(candidate.scales)
    systems = effect_systems(shooting, fit, effects, around, None, at)
    evidence = Evidence(systems, fit.values, base_deviations(shooting))
    assert evidence.n_base == n_base(shooting)
    found = Mechanics(shooting, fit, evidence, coefficients, {e.NAME: e for e in effects}, around)
    return converged(found, None, USUAL, 3)


def test_what_is_there_grows_and_what_is_not_goes(mechanics: Mechanics) -> None:
    screened = mechanical_findings(mechanics, USUAL)
    base, models = race(mechanics, (3, 3))
    assert float(models["anisotropic_stiffness"].effects[0].value("bending")) < -1.0
    gained = {name: model.gained for name, model in models.items()}
    assert base.gained == 0
    first = {name: found.log_evidence for name, found in screened.findings.items()}
    assert gained["anisotropic_stiffness"] > first["anisotropic_stiffness"] + 10 > 10
    others = [gained[name] for name in ("frame_rate", "air_drag") if name in gained]
    assert max(others, default=0.0) < 0.1 * gained["anisotropic_stiffness"]


def test_the_last_drop_out_and_the_first_go_on(mechanics: Mechanics) -> None:
    base, early = race(mechanics, (3,))
    _, late = race(mechanics, (3, 1))
    assert late["anisotropic_stiffness"].gained > early["anisotropic_stiffness"].gained
    for name in set(early) - {"anisotropic_stiffness"}:
        assert late[name].gained == early[name].gained < early["anisotropic_stiffness"].gained
    assert not base.effects


def race(mechanics: Mechanics, tried: tuple[int, ...]) -> tuple[Refit, dict[str, Refit]]:
    screened = mechanical_findings(mechanics, USUAL)
    order = sorted(NAMES, key=lambda name: -screened.findings[name].log_evidence)
    free = {name: screened.free[name] for name in order if screened.free[name]}
    found = refits(mechanics, free, screened.penalties, USUAL, tried, lambda what, share: None)
    return found.base, found.effects


def test_the_size_of_an_effect_is_how_far_it_moves_the_cloth(mechanics: Mechanics) -> None:
    _, models = race(mechanics, (3,))
    sizes = {name: effect_size(mechanics, model) for name, model in models.items()}
    assert 1e-4 < sizes["anisotropic_stiffness"] < 0.05
    model = models["anisotropic_stiffness"]
    # By the numbers that are estimated, however far the refit has come.
    nothing = replace(model, mean=np.zeros_like(model.mean))
    assert effect_size(mechanics, nothing) == pytest.approx(0.0, abs=1e-6)
    half = replace(model, mean=0.5 * model.mean)
    assert effect_size(mechanics, half) < 0.9 * sizes["anisotropic_stiffness"]


def test_passes_end_and_steps_are_as_long_as_the_settings_say(mechanics: Mechanics) -> None:
    s, fit = mechanics.shooting, mechanics.fit
    start = fit.values + np.array([0.5, 0.0, 0.0, 0.0, 0.0])
    base = base_of(fit.start_material, start)

    def passes(**settings: float) -> BaseFit:
        changed = replace(s.settings, **settings)
        shooting = Shooting(
            s.simulator, s.substeps, s.gravity, s.horizontal, s.grid, s.boundary, s.tracked, changed
        )
        windows = [shooting.simulate(w, w.standardised, base) for w in fit.windows]
        return improved(shooting, windows, fit.start_material, start, lambda what, cost: None, passes=2)

    short = passes(longest_stiffness=1e-3)
    assert 0 < np.abs(short.values - start)[:3].max() <= 2.001e-3
    usual = passes()
    assert np.abs(usual.values - start)[:3].max() > 0.01
    # A gain that counts as nothing ends it after the first undamped pass.
    assert len(usual.history) == 3
    assert len(passes(nothing=1e12).history) == 2


def test_a_hypothesis_is_done_when_the_settings_say(mechanics: Mechanics) -> None:
    screened = mechanical_findings(mechanics, USUAL)
    free = {"anisotropic_stiffness": screened.free["anisotropic_stiffness"]}

    def change(settings: RefitSettings) -> float:
        race = refits(
            mechanics, free, screened.penalties, USUAL, (1,), lambda what, share: None, settings=settings
        )
        moved = race.effects["anisotropic_stiffness"].base.wind - mechanics.fit.base.wind
        return float(np.abs(moved).max())

    assert 0 < change(RefitSettings(longest_wind=1e-4)) <= 1.001e-4
    assert change(RefitSettings()) > 2e-4
