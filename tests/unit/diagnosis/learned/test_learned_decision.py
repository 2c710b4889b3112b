from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sklearn.ensemble import HistGradientBoostingClassifier

from toile.diagnosis.learned.balance import BASE, balance
from toile.diagnosis.learned.decision import LearnedDecision
from toile.diagnosis.learned.features import GROUPS, clip_features
from toile.diagnosis.learned.fields import Fields
from toile.diagnosis.learned.measures import calibration_error
from toile.diagnosis.learned.motion import long_enough, observed_motion
from toile.diagnosis.learned.trees import Trees, exported
from toile.errors import InputError
from toile.generation.fast.clips import LabelledClip, draw_batch


@lru_cache
def clips() -> list[LabelledClip]:
    return draw_batch(7, 0)


def features(clip: LabelledClip) -> dict[str, float]:
    return clip_features(clip.positions, clip.pinned, clip.fps, clip.gravity, clip.cloth_size)


def pendulum(rate: float, wind: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """A stiff sheet that swings about its upper edge: x(t) with drag ``rate`` per velocity [1/s]."""
    steps, per_frame, length = 80 * 40, 40, 0.5
    angle, speed, angles = 0.5, 0.0, []
    dt = 1 / (50 * per_frame)
    # All of a rigid sheet: inertia ∫ r², weight and wind ∫ r, drag ∫ r² of a uniform density.
    for step in range(steps):
        if step % per_frame == 0:
            angles.append(angle)
        pull = (-9.81 * np.sin(angle) + wind * np.cos(angle)) * 1.5 / length
        speed += dt * (pull - rate * speed)
        angle += dt * speed
    v, u = np.meshgrid(np.linspace(0, length, 16), np.linspace(0, length, 16), indexing="ij")
    a = np.array(angles)[:, None, None]
    positions = np.stack([u + 0 * a, v * np.cos(a), v * np.sin(a)], -1)
    return positions, np.array([0, 9.81, 0])


def balance_of(positions: np.ndarray, gravity: np.ndarray, pinned: tuple[int, ...] = (0, 15)):
    return balance(Fields(observed_motion(positions, pinned, 50.0, gravity, (0.5, 0.5)))).blocks


def test_the_balance_measures_the_drag_of_a_swinging_sheet() -> None:
    for rate in (0.0, 1.0, 3.0):
        b = balance_of(*pendulum(rate), pinned=tuple(range(16)))
        value, _ = b.signed((*BASE, "drag_linear"), "drag_linear")
        in_seconds = value[0] * np.sqrt(9.81 / 0.5)
        assert in_seconds == pytest.approx(rate, abs=0.12 + 0.1 * rate)


def test_the_balance_measures_a_steady_wind() -> None:
    b = balance_of(*pendulum(1.0, wind=1.5), pinned=tuple(range(16)))
    names = ("wind", "drag_linear")
    value, _ = b.signed(names, "wind")
    assert abs(value[1]) * 9.81 == pytest.approx(1.5, rel=0.15)


def test_features_are_finite_and_know_no_place_direction_or_grid_order() -> None:
    clip = clips()[0]
    plain = features(clip)
    assert 300 < len(plain) < 1000
    assert {name.partition(".")[0] for name in plain} == set(GROUPS)
    assert all(np.isfinite(list(plain.values())))
    turn = Rotation.from_euler("xyz", (20, 130, -40), degrees=True).as_matrix()
    moved = clip_features(
        clip.positions @ turn.T + (3, -2, 1), clip.pinned, clip.fps, turn @ clip.gravity, clip.cloth_size
    )
    upside_down = clip_features(
        clip.positions[:, ::-1].transpose(0, 2, 1, 3)[:, ::-1],
        _turned(clip),
        clip.fps,
        clip.gravity,
        clip.cloth_size[::-1],
    )
    for name, value in plain.items():
        assert moved[name] == pytest.approx(value, rel=2e-3, abs=2e-3), name
    for name in ("balance.left", "balance.gain.drag", "shape.kvv.over_cloth", "energy.kinetic"):
        assert upside_down[name] == pytest.approx(plain[name], rel=1e-3, abs=1e-3), name


def test_bad_input_says_what_is_wrong() -> None:
    clip = clips()[0]
    with pytest.raises(InputError, match="Too few frames"):
        clip_features(clip.positions[:5], clip.pinned, clip.fps, clip.gravity, clip.cloth_size)
    with pytest.raises(InputError, match="not finite"):
        clip_features(clip.positions * np.nan, clip.pinned, clip.fps, clip.gravity, clip.cloth_size)
    with pytest.raises(InputError, match="No vertex"):
        clip_features(clip.positions, (), clip.fps, clip.gravity, clip.cloth_size)


@lru_cache
def small_model() -> tuple[HistGradientBoostingClassifier, np.ndarray]:
    rng = np.random.default_rng(0)
    x = rng.standard_normal((600, 5)).astype(np.float32)
    x[rng.random(x.shape) < 0.1] = np.nan
    y = np.digitize(np.nan_to_num(x[:, 0] + 0.5 * x[:, 1]), (-0.5, 0.7))
    return HistGradientBoostingClassifier(max_iter=20, max_leaf_nodes=8).fit(x, y), x


def test_exported_trees_score_as_scikit_learn_does() -> None:
    model, x = small_model()
    trees = exported(model)
    again = Trees.from_arrays(trees.arrays())
    expected = model.decision_function(x)
    np.testing.assert_allclose(trees.scores(x.astype(np.float64)), expected, atol=1e-6)
    np.testing.assert_allclose(again.scores(x.astype(np.float64)), expected, atol=1e-6)


def small_decision() -> LearnedDecision:
    names = tuple("abcde")
    return LearnedDecision(
        ("none", "gusts", "outside"),
        names,
        np.array([[-4.0, 4.0]] * 5),
        exported(small_model()[0]),
        temperature=1.3,
        session_power=0.8,
        log_prior=np.log([0.3, 0.4, 0.3]),
    )


def test_a_decision_is_stored_and_read_without_pickle(tmp_path: Path) -> None:
    decision = small_decision()
    decision.save(tmp_path / "weights.npz")
    read = LearnedDecision.load(tmp_path / "weights.npz")
    row = {"a": 0.4, "b": -1.0, "c": float("nan"), "d": 0.0, "e": 1.0}
    assert read.posterior(row) == pytest.approx(decision.posterior(row), abs=1e-6)
    assert sum(read.posterior(row).values()) == pytest.approx(1)
    with pytest.raises(InputError, match="No learned decision"):
        LearnedDecision.load(tmp_path / "other.npz")


def test_the_weights_of_the_package_know_the_features() -> None:
    decision = LearnedDecision.load()
    row = features(clips()[0])
    assert set(decision.names) <= set(row)
    posterior = decision.posterior(row)
    assert sum(posterior.values()) == pytest.approx(1)
    assert len(decision.outside_range(row)) < 0.05 * len(decision.names)


def test_features_beyond_training_are_dropped_and_named() -> None:
    decision = small_decision()
    row = {"a": 400.0, "b": -1.0, "c": 0.1, "d": 0.0, "e": 1.0}
    assert decision.outside_range(row) == ("a",)
    assert decision.posterior(row) == decision.posterior(row | {"a": float("nan")})


def test_clips_of_a_session_add_up() -> None:
    decision = small_decision()
    row = {"a": 0.1, "b": 0.2, "c": 0.1, "d": 0.0, "e": 1.0}
    one, three = decision.posterior(row), decision.session_posterior([row] * 3)
    best = max(one, key=lambda k: one[k])
    assert decision.session_posterior([row]) == pytest.approx(one)
    assert three[best] > one[best]


def test_calibration_error_of_sure_and_wrong_is_large() -> None:
    p = np.tile([0.9, 0.1], (100, 1))
    right = np.array([0] * 90 + [1] * 10)
    assert calibration_error(p[:, :], np.random.default_rng(0).permutation(right)) < 0.1
    assert calibration_error(p, np.ones(100, int)) == pytest.approx(0.9)


def _turned(clip: LabelledClip) -> list[int]:
    """Pinned vertices of the clip after [:, ::-1], transposition and [:, ::-1] of its grid."""
    H, W = clip.positions.shape[1:3]
    index = np.arange(H * W).reshape(H, W)[::-1].T[::-1].ravel()
    return [int(np.flatnonzero(index == k)[0]) for k in clip.pinned]


@pytest.mark.parametrize(
    ("n_frames", "fps", "enough"),
    [
        (24, 50.0, True),
        (23, 50.0, False),
        (24, 25.0, True),
        (24, 120.0, False),
        (60, 240.0, False),
        (160, 240.0, True),
    ],
)
def test_frames_that_follow_fast_have_to_be_more(n_frames: int, fps: float, enough: bool) -> None:
    """Slow motion of a telephone: 24 frames at 240 a second end within what is smoothed over."""
    assert long_enough(n_frames, fps) is enough
    if not enough:
        return
    rows, columns = np.meshgrid(np.linspace(0, 0.4, 8), np.linspace(0, 0.4, 8), indexing="ij")
    times = np.arange(n_frames) / fps
    waves = 0.02 * np.sin(12 * times[:, None, None] + 9 * rows)
    positions = np.stack(
        [np.broadcast_to(columns, waves.shape), np.broadcast_to(rows, waves.shape), 1 + waves], -1
    )
    found = clip_features(positions, [0, 7], fps, np.array([0.0, 9.81, 0.0]), (0.4, 0.4))
    finite = [np.isfinite(value) for value in found.values()]
    assert np.mean(finite) > 0.9
