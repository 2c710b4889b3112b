"""The time step's own error."""

from __future__ import annotations

import numpy as np
import torch

from toile.diagnosis.base_fit import BaseFit
from toile.diagnosis.numerics import refined, time_step_error
from toile.diagnosis.shooting import Shooting, ShootingSettings, WindowMotion
from toile.diagnosis.tracked import Tracked
from toile.physics.cloth import grid_cloth
from toile.physics.implicit.integrators import BDF2
from toile.physics.implicit.newton import NewtonSettings
from toile.physics.implicit.simulator import ImplicitSimulator
from toile.physics.state import State

GRID = (6, 6)
FRAMES = 7


def fitted(substeps: int) -> tuple[Shooting, BaseFit]:
    """A cloth that swings about its pinned corners."""
    cloth = grid_cloth(GRID, (0.3, 0.3), 0.15, (0, 30))
    i, j = torch.meshgrid(torch.arange(6), torch.arange(6), indexing="ij")
    x = (
        torch.stack((i * 0.06, j * 0.06 * np.cos(0.4), 1 + j * 0.06 * np.sin(0.4)), -1)
        .reshape(1, -1, 3)
        .double()
    )
    n = 3 * x.shape[1]
    positions = np.repeat(x.numpy(), FRAMES, 0)
    tracked = Tracked(positions, [np.zeros((n, n), np.float32)] * FRAMES, np.zeros_like(positions), positions)
    simulator = ImplicitSimulator(cloth, 0.04 / substeps, BDF2(), NewtonSettings(1e-8))
    horizontal = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    gravity = np.array([0.0, 9.81, 0.0])
    boundary = positions[:, cloth.pinned.numpy()]
    shooting = Shooting(
        simulator, substeps, gravity, horizontal, GRID, boundary, tracked, ShootingSettings(modes=2)
    )
    stiffness = np.array([400.0, 1e-2, 1e-4])
    state = State.start(x, torch.zeros_like(x), simulator.time_step, simulator.n_past)
    standardised = np.zeros(shooting.layout(FRAMES - 1)[2])
    fit = BaseFit([], stiffness, np.zeros(5), 0.0, ())
    window = shooting.simulate(WindowMotion(0, FRAMES - 1, state, standardised), standardised, fit.base)
    fit.windows.append(window)
    assert window.converged
    return shooting, fit


def test_falls_with_the_step() -> None:
    """By more than the step does."""
    coarse, middle, fine = (time_step_error(*fitted(n)) for n in (4, 16, 64))
    assert coarse > 1e-4
    assert coarse / middle > 5
    assert middle / fine > 5


def test_steps_are_halved_until_shorter_ones_change_nothing() -> None:
    shooting, fit = fitted(4)
    before = time_step_error(shooting, fit)
    quiet = []
    finer, better = refined(shooting, fit, 0.3 * before, 1e-6, lambda what, cost: quiet.append(what))
    assert finer.substeps > shooting.substeps
    assert time_step_error(finer, better) <= 0.3 * before
    # One halving less would not have been enough.
    half, worse = refined(shooting, fit, 0.3 * before, 2 * finer.simulator.time_step, lambda what, cost: None)
    assert 2 * half.substeps == finer.substeps
    assert time_step_error(half, worse) > 0.3 * before
    # Unknowns go along: the motion stays near.
    a, b = fit.windows[0].positions[-1], better.windows[0].positions[-1]
    assert np.linalg.norm(a - b, axis=-1).mean() < 5 * before
    np.testing.assert_allclose(better.windows[0].standardised, fit.windows[0].standardised, atol=1e-6)


def test_steps_that_are_short_enough_stay() -> None:
    shooting, fit = fitted(16)
    same, kept = refined(shooting, fit, 1.0, 1e-6, lambda what, cost: None)
    assert same is shooting
    assert kept is fit
