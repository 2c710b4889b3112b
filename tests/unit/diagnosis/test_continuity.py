"""Windows that follow one another, against the same quadratic written down as a whole."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from toile.diagnosis.base_fit import base_of, base_sensitivities, nothing_seen, window_systems
from toile.diagnosis.continuity import Discrepancy, Joined, Link, WindowSystem
from toile.diagnosis.shooting import Shooting, ShootingSettings, WindowMotion
from toile.diagnosis.tracked import Tracked
from toile.physics.cloth import grid_cloth
from toile.physics.implicit.integrators import BDF2
from toile.physics.implicit.newton import NewtonSettings
from toile.physics.implicit.simulator import ImplicitSimulator
from toile.physics.state import State

N_SHARED, N_START, N_LOCAL = 3, 2, 6
INTERNAL = np.array([False, False, False, True, True, False])
EXTERNAL = np.array([False, False, False, False, False, True])
FITTED, SIZE = Discrepancy(0.7, 0.1), Discrepancy(0.4, 0.2)


def systems(seed: int, n: int = 3) -> list[WindowSystem]:
    rng = np.random.default_rng(seed)
    found = []
    for k in range(n):
        J = rng.normal(size=(12, N_SHARED + N_LOCAL))
        link = None
        if k:
            before = rng.normal(size=(N_START, N_SHARED + N_LOCAL))
            link = Link(rng.normal(size=N_START), rng.uniform(2, 4, N_START), before)
        standardised = rng.normal(size=N_LOCAL)
        found.append(
            WindowSystem(J.T @ J, J.T @ rng.normal(size=12), standardised, INTERNAL, EXTERNAL, FITTED, link)
        )
    return found


def whole(all_systems: list[WindowSystem]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Matrix, gradient, deviations of the local unknowns, of [shared | all windows], priors among them."""
    total = N_SHARED + N_LOCAL * len(all_systems)
    scale = np.where(INTERNAL, SIZE.internal, np.where(EXTERNAL, SIZE.external, 1.0))
    fitted = np.where(INTERNAL, FITTED.internal, np.where(EXTERNAL, FITTED.external, 1.0))
    H, g = np.zeros((total, total)), np.zeros(total)
    for k, s in enumerate(all_systems):
        own = N_SHARED + N_LOCAL * k + np.arange(N_LOCAL)
        at = np.concatenate((np.arange(N_SHARED), own))
        H[np.ix_(at, at)] += s.matrix
        g[at] += s.gradient
        rows, residual = np.zeros((N_LOCAL, total)), s.standardised * fitted / scale
        rows[np.arange(N_LOCAL), own] = 1 / scale
        if s.link is not None:
            past = np.concatenate((np.arange(N_SHARED), own - N_LOCAL))
            rows[:N_START] = 0
            rows[np.arange(N_START), own[:N_START]] = s.link.ratio
            rows[np.ix_(np.arange(N_START), past)] -= s.link.before
            residual[:N_START] = s.link.jump
        H += rows.T @ rows
        g += rows.T @ residual
    return H, g, np.tile(scale, len(all_systems))


def test_local_unknowns_are_eliminated() -> None:
    all_systems = systems(0)
    H, g, _ = whole(all_systems)
    reduced = Joined(all_systems, SIZE).reduced
    a, b = slice(0, N_SHARED), slice(N_SHARED, None)
    np.testing.assert_allclose(reduced.matrix, H[a, a] - H[a, b] @ np.linalg.solve(H[b, b], H[b, a]))
    np.testing.assert_allclose(reduced.right, -g[a] + H[a, b] @ np.linalg.solve(H[b, b], g[b]))


def test_constants_differ_as_gaussian_integrals_do() -> None:
    """Whatever the size, what is left out of the constant is the same."""
    left_out = []
    for seed in (0, 1):
        all_systems = systems(seed)
        H, g, scale = whole(all_systems)
        b = slice(N_SHARED, None)
        standardised = scale[:, None] * H[b, b] * scale
        value = 0.5 * g[b] @ np.linalg.solve(H[b, b], g[b]) - 0.5 * np.linalg.slogdet(standardised)[1]
        for k, s in enumerate(all_systems):
            at = slice(N_LOCAL * k, N_LOCAL * (k + 1))
            mean = s.standardised * np.where(INTERNAL, 0.7, np.where(EXTERNAL, 0.1, 1.0)) / scale[at]
            m = 0 if s.link is None else N_START
            value -= 0.5 * mean[m:] @ mean[m:]
            value -= 0.0 if s.link is None else 0.5 * s.link.jump @ s.link.jump
        reduced = Joined(all_systems, SIZE).reduced
        left_out.append(value - (reduced.constant - reduced.determinant))
    assert left_out[0] == pytest.approx(0.0, abs=1e-9)
    assert left_out[1] == pytest.approx(0.0, abs=1e-9)


def test_local_unknowns_follow_the_shared_ones() -> None:
    all_systems = systems(2)
    H, g, _ = whole(all_systems)
    shared = np.array([0.3, -0.2, 0.1])
    b = slice(N_SHARED, None)
    best = np.linalg.solve(H[b, b], -g[b] - H[b, :N_SHARED] @ shared)
    np.testing.assert_allclose(np.concatenate(Joined(all_systems, SIZE).locals(shared)), best)


def test_a_step_promises_what_the_quadratic_falls_by() -> None:
    all_systems = systems(3)
    H, g, _ = whole(all_systems)
    joined, shared = Joined(all_systems, SIZE), np.array([0.3, -0.2, 0.1])
    step = np.concatenate((shared, *joined.locals(shared)))
    assert joined.promised(shared) == pytest.approx(-(g @ step + 0.5 * step @ H @ step))
    # A damped step goes less far, and promises no more than it keeps.
    damped = Joined(all_systems, SIZE, 5.0)
    step = np.concatenate((shared, *damped.locals(shared)))
    assert damped.promised(shared) < -(g @ step + 0.5 * step @ H @ step)


def test_the_end_of_a_window_moves_as_its_derivative_says() -> None:
    """With the wind, and with the start."""
    frames, substeps = 5, 3
    cloth = grid_cloth((6, 6), (0.3, 0.3), 0.15, (0, 30))
    i, j = torch.meshgrid(torch.arange(6), torch.arange(6), indexing="ij")
    x = torch.stack((i * 0.06, j * 0.06 * np.cos(0.4), 1 + j * 0.06 * np.sin(0.4)), -1).reshape(1, -1, 3)
    x = x.double()
    n = 3 * x.shape[1]
    positions = np.repeat(x.numpy(), 2 * frames - 1, 0)
    tracked = Tracked(
        positions,
        [np.zeros((n, n), np.float32)] * len(positions),
        np.zeros_like(positions),
        positions,
    )
    simulator = ImplicitSimulator(cloth, 0.04 / substeps, BDF2(), NewtonSettings(1e-10))
    horizontal = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    boundary = positions[:, cloth.pinned.numpy()]
    shooting = Shooting(
        simulator,
        substeps,
        np.array([0.0, 9.81, 0.0]),
        horizontal,
        (6, 6),
        boundary,
        tracked,
        ShootingSettings(modes=2),
    )
    stiffness = np.array([400.0, 1e-2, 1e-4])
    state = State.start(x, torch.zeros_like(x), simulator.time_step, simulator.n_past)
    standardised = np.zeros(shooting.layout(frames - 1)[2])

    def run(values: np.ndarray, moved: np.ndarray) -> WindowMotion:
        window = WindowMotion(0, frames - 1, state, moved)
        return shooting.simulate(window, moved, base_of(stiffness, values))

    first = run(np.zeros(5), standardised)
    assert first.end is not None
    second = shooting.simulate(
        WindowMotion(frames - 1, 2 * frames - 2, first.end, standardised),
        standardised,
        base_of(stiffness, np.zeros(5)),
    )
    base = base_of(stiffness, np.zeros(5))
    sensitivities = [base_sensitivities(shooting, base)] * 2
    link = window_systems(shooting, [first, second], base, sensitivities, nothing_seen, 5)[1].link
    assert link is not None
    np.testing.assert_allclose(link.jump, 0, atol=1e-9)
    small = 1e-3
    values, moved = np.zeros(5), standardised.copy()
    values[4] = small
    moved[1] = moved[shooting.n_fields + 2] = small
    changed = shooting.jump(run(values, moved), second)
    unit = link.before[:, 4] + link.before[:, 5 + 1] + link.before[:, 5 + shooting.n_fields + 2]
    found = -changed / small
    assert np.linalg.norm(found - unit) < 0.02 * np.linalg.norm(unit)
