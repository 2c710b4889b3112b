"""Where a model is wrong: errors that differ from place to place, found from what is left."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import toile.diagnosis.session_stages as stages
from toile.diagnosis.image_information import SoftenedInformation, quadratic
from toile.diagnosis.model_errors import model_errors
from toile.diagnosis.session_settings import SessionSettings
from toile.diagnosis.session_stages import RefinedMotion, with_uneven_errors
from toile.diagnosis.softened import ModelError, softened
from toile.diagnosis.tracked import Tracked
from toile.diagnosis.uneven_errors import uneven_errors
from toile.physics.cloth import grid_cloth

Array = NDArray[np.float64]

SIDE, WIDTH, FPS = 8, 0.4, 25.0
N = SIDE * SIDE
FRAMES = 60
ERROR = ModelError(share=0.004, modes=16, frames=1.0)
NOISE = 0.002
"""Of the images [m]."""
VARIANCE = (ERROR.share * WIDTH) ** 2 * N / ERROR.modes
CLOTH = grid_cloth((SIDE, SIDE), (WIDTH, WIDTH), 0.15, (0, SIDE - 1))


def at_the_border() -> Array:
    """Errors of twenty times the variance along the first column."""
    relative = np.ones((SIDE, SIDE))
    relative[:, :2] = 20.0
    return relative.reshape(-1)


def images(relative: Array, rng: np.random.Generator) -> Tracked:
    """Of a cloth that is where a model of such errors has it, give or take those errors."""
    sees = np.diag(rng.uniform(0.3, 3.0, 3 * N)) / NOISE**2
    positions = np.zeros((FRAMES, N, 3))
    errors = np.sqrt(VARIANCE * relative)[:, None] * rng.standard_normal((FRAMES, N, 3))
    noise = rng.standard_normal((FRAMES, 3 * N)) / np.sqrt(np.diag(sees))
    gradient = -(errors.reshape(FRAMES, -1) + noise) @ sees
    every = [sees.astype(np.float32)] * FRAMES
    return Tracked(positions, every, gradient.reshape(positions.shape), positions)


def problem(tracked: Tracked, error: ModelError, uneven: Array | None) -> tuple[Any, list[Any]]:
    """A clip and the model's motion, which is where it is linearised."""
    soft = softened(tracked, WIDTH, FPS, 1.0, error, uneven)
    shooting = SimpleNamespace(tracked=soft, substeps=1, weight=1.0, simulator=SimpleNamespace(cloth=CLOTH))
    return shooting, [SimpleNamespace(positions=tracked.positions)]


def test_images_are_no_surer_than_the_model_is_right_in_each_place() -> None:
    rng = np.random.default_rng(1)
    root = rng.standard_normal((3 * N, 3 * N)) / NOISE
    sees = root @ root.T / (3 * N)
    x = np.zeros((1, N, 3))
    slope = rng.standard_normal((1, N, 3))
    relative = rng.uniform(0.2, 9.0, N)
    soft = softened(Tracked(x, [sees.astype(np.float32)], slope, x), WIDTH, FPS, 0.5, ERROR, relative)
    information = soft.information[0]
    assert isinstance(information, SoftenedInformation)
    variances = np.repeat(VARIANCE * relative, 3)
    np.testing.assert_allclose(information.variances(), variances, rtol=1e-5)
    # (I⁻¹ + D)⁻¹ = I (1 + D I)⁻¹, and slopes go with it.
    weighed = 0.5 * sees
    within = np.linalg.inv(np.eye(3 * N) + variances[:, None] * weighed)
    expected = weighed @ within
    largest = np.abs(expected).max()
    np.testing.assert_allclose(information.toarray(), expected, atol=2e-4 * largest)
    right = rng.standard_normal((3 * N, 2))
    for given in (right, right[:, 0]):
        np.testing.assert_allclose(
            information @ given, expected @ given, atol=2e-4 * np.abs(expected @ given).max()
        )
    square = right.T @ expected @ right
    np.testing.assert_allclose(
        quadratic(information, right.astype(np.float32)), square, atol=2e-4 * np.abs(square).max()
    )
    of_slopes = within.T @ (0.5 * slope.reshape(-1))
    np.testing.assert_allclose(soft.gradient.reshape(-1), of_slopes, atol=1e-6 * np.abs(of_slopes).max())
    np.testing.assert_allclose(information.known(), 1 - np.diag(within), atol=1e-4)


@pytest.mark.parametrize("relative", [np.ones(N), at_the_border()])
def test_where_the_model_is_wrong_is_found_from_what_it_leaves(relative: Array) -> None:
    tracked = images(relative, np.random.default_rng(2))
    # Their size is what the model's smooth errors say, so it is thought to be what it is.
    share = ERROR.share * float(np.sqrt(relative.mean()))
    error = ModelError(share, ERROR.modes, ERROR.frames)
    found: Array | None = None
    for _ in range(4):
        found = uneven_errors(*problem(tracked, error, found), error.lasting(FPS), found)
    assert found is not None
    masses = CLOTH.masses.numpy()
    assert (masses @ found) / masses.sum() == pytest.approx(1.0)
    of_columns = found.reshape(SIDE, SIDE).mean(0)
    true = relative.reshape(SIDE, SIDE).mean(0)
    # Where it changes by a factor from one column to the next, the neighbours have a part of it.
    apart = of_columns[0] / of_columns[-3:].mean()
    assert apart == pytest.approx(true[0] / true[-1], rel=0.3)
    assert of_columns[3:].max() / of_columns[3:].min() < 2.0


def test_uneven_errors_cost_what_is_expected_of_them() -> None:
    relative = at_the_border()
    shares = CLOTH.masses.numpy() / CLOTH.masses.numpy().sum()
    uneven = relative / (shares @ relative)
    error = ModelError(ERROR.share * float(np.sqrt(shares @ relative)), ERROR.modes, ERROR.frames)
    costs, thought_even = [], []
    for seed in range(3):
        tracked = images(relative, np.random.default_rng(seed))
        shooting, windows = problem(tracked, error, uneven)
        right = model_errors(shooting, windows, WIDTH, error, uneven)
        costs.append(right.cost / right.expected)
        shooting, windows = problem(tracked, error, None)
        wrong = model_errors(shooting, windows, WIDTH, error)
        thought_even.append(wrong.cost / wrong.expected)
    assert np.mean(costs) == pytest.approx(1.0, abs=0.15)
    # Their size would seem to be another one, for images see most of the cloth to be better than that.
    assert abs(np.log(np.mean(thought_even))) > 2 * abs(np.log(np.mean(costs)))


def test_rounds_hand_on_what_they_found_and_none_leave_errors_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    thought: list[tuple[float | None, float | None]] = []

    def model(clips: Any, motion: RefinedMotion, settings: Any, stiffness: Any) -> Any:
        thought.append((motion.error, None if motion.uneven is None else float(motion.uneven[0][0])))
        base = SimpleNamespace(values=np.zeros(5), windows=[[]])
        return SimpleNamespace(
            fitting=SimpleNamespace(
                start_fit=lambda workers: None, fitted=lambda *given: base, costed=lambda *given: base
            ),
            errors=lambda fit: SimpleNamespace(found=0.002 - 0.0005 * len(thought)),
            uneven_errors=lambda fit: [np.full(4, float(len(thought)))],
        )

    monkeypatch.setattr(stages, "SessionModel", model)
    begin = RefinedMotion([np.zeros((2, 4, 3))], None, error=0.003)
    settings = SessionSettings(uneven_rounds=3)
    found = with_uneven_errors([], begin, settings, (850.0, 0.5, 0.005))
    assert thought == [(0.003, None), (0.0015, 1.0), (0.001, 2.0)]
    assert found.error == 0.0005
    assert found.uneven is not None
    assert found.uneven[0][0] == 3.0
    alike = SessionSettings(uneven_rounds=0)
    assert with_uneven_errors([], begin, alike, (850.0, 0.5, 0.005)) is begin
