"""Errors of a right model, fits of a toy, probabilities and answers."""

from __future__ import annotations

import numpy as np
import pytest

from toile.diagnosis.effect_evidence import SIZES
from toile.diagnosis.garment.bounded_evidence import BoundedEvidence
from toile.diagnosis.garment.diagnosis import Calibration
from toile.diagnosis.garment.effects import EFFECTS
from toile.diagnosis.garment.error_model import ErrorModel, Weighing
from toile.diagnosis.garment.fit import ClipFitting, split
from toile.diagnosis.garment.masks import SmoothedAreas
from toile.diagnosis.garment.responses import measure_responses
from toile.diagnosis.garment.rollout import Seen
from toile.diagnosis.garment.scene import Scene
from toile.diagnosis.garment.verdict import AMBIGUOUS, NONE, DecisionWeights, Verdict

E = len(EFFECTS)


def test_weighing_is_the_inverse_covariance() -> None:
    rng = np.random.default_rng(0)
    errors, vector = rng.normal(size=(12, E)), rng.normal(size=12)
    covariance = 0.7 * np.eye(12) + errors @ errors.T
    assert Weighing(0.7, errors)(vector) == pytest.approx(np.linalg.solve(covariance, vector))


def test_null_clips_say_how_many_numbers_count_as_one_and_what_is_usual() -> None:
    rng = np.random.default_rng(1)
    usual = np.geomspace(0.1, 2.0, E)
    clips = []
    for _ in range(60):
        answers = np.repeat(rng.normal(size=(60, E)), 20, axis=0)
        # Twenty neighbours err alike.
        noise = np.repeat(rng.normal(size=60), 20)
        clips.append((answers @ (usual * rng.normal(size=E)) + noise, answers))
    found = ErrorModel.of(clips)
    assert found.alike == pytest.approx(20, rel=0.35)
    assert np.array(list(found.usual.values()))[2:] == pytest.approx(usual[2:], rel=0.35)
    assert ErrorModel.from_dict(found.to_dict()) == found


class Toy:
    """Masks that answer to two effects, to one of them not in proportion."""

    def __call__(self, scene: Scene, cameras: int | None = None) -> Seen:
        rng = np.random.default_rng(0)
        base, girth, slip = (rng.normal(size=(1, 2, 6, 8, 8)) for _ in range(3))
        moved = base + np.sin(40 * scene.girth) * girth + 30 * scene.slip * slip
        # Every field must answer, or nothing can be explained by it.
        rest = scene.bias + scene.friction + scene.stiffness + scene.drag + scene.thigh
        return Seen(np.zeros((6, 1, 3)), moved + 1e-3 * rest * rng.normal(size=base.shape), 1.0)


class AsTheyAre(SmoothedAreas):
    """Masks that are compared as they are."""

    def __call__(self, masks: np.ndarray) -> np.ndarray:
        return masks


def toy_fit(scene: Scene) -> ClipFitting:
    responses = measure_responses(Toy(), Scene(), AsTheyAre())
    errors = ErrorModel(0.01, 0.01, dict.fromkeys(EFFECTS, 1e-3), 1)
    observed = Toy()(scene).masks
    noise = 0.1 * np.random.default_rng(5).normal(size=observed.shape)
    return ClipFitting(Toy(), Scene(), responses, observed + noise, errors, AsTheyAre())


def test_a_step_that_the_line_does_not_reach_is_simulated_again() -> None:
    """sin(40 · 0.03) is far from 40 · 0.03: the first step falls short, the secant goes on."""
    effect = EFFECTS["body_shape"]
    fits = toy_fit(effect.changed(Scene(), 7.5)).fit()
    assert fits.best.effect == "body_shape"
    assert fits.best.simulated >= 2
    assert fits.best.coefficient == pytest.approx(7.5, abs=0.3)
    assert fits.excess < 1.2


def test_an_interval_holds_the_truth_and_bounds_hold_the_coefficient() -> None:
    fits = toy_fit(EFFECTS["waist_slip"].changed(Scene(), 1.0)).fit()
    low, high = fits.interval("waist_slip")
    assert low < 1.0 < high < 1.2
    assert fits.fits["air_drag"].coefficient >= EFFECTS["air_drag"].least(Scene()) == pytest.approx(-1.25)
    assert max(fits.nats[name] for name in EFFECTS if name != "waist_slip") < fits.nats["waist_slip"] - 20


def test_evidence_at_a_bound_is_the_integral_over_what_lies_within() -> None:
    given = BoundedEvidence(drop=4.0, coefficient=-1.25, slope=1.5, information=2.0)
    c = np.linspace(-1.25, 60, 400_001)
    for scale in (1.0, 2.5):
        gain = (4.0 - 1.5 * (c + 1.25) - 0.5 * 2.0 * (c + 1.25) ** 2) / scale
        means = []
        for size in SIZES:
            prior = np.exp(-0.5 * (c / size) ** 2)
            means.append(np.trapezoid(np.exp(gain) * prior, c) / np.trapezoid(prior, c))
        assert given.nats(scale) == pytest.approx(float(np.log(np.mean(means))), abs=1e-4)


def test_frames_are_split() -> None:
    assert split(12) == (slice(0, 8), slice(8, 12))
    assert split(3) == (slice(0, 2), slice(2, 3))


def test_answers_need_nine_tenths() -> None:
    assert Verdict.of({NONE: 0.05, "a": 0.92, "b": 0.03}).answer == "a"
    shared = Verdict.of({NONE: 0.3, "a": 0.65, "b": 0.05})
    assert (shared.answer, shared.candidates) == (AMBIGUOUS, ("a", NONE))
    assert Verdict.of({NONE: 0.95, "a": 0.05}).answer == NONE


def test_weights_are_learnt_from_clips() -> None:
    weights = DecisionWeights(threshold=2.0, temperature=3.0)
    rng = np.random.default_rng(2)
    clips = []
    for _ in range(150):
        nats = {name: float(rng.normal(0, 8)) for name in ("a", "b")}
        shares = weights.probabilities(nats)
        clips.append((str(rng.choice(list(shares), p=list(shares.values()))), nats))
    found = DecisionWeights.learnt(clips)
    assert found.threshold == pytest.approx(2.0, abs=1.5)
    assert found.temperature == pytest.approx(3.0, rel=0.4)


def test_the_packages_calibration_reads() -> None:
    calibration = Calibration.load()
    assert set(calibration.errors) >= {1, 4}
    assert all(model.alike > 1 for model in calibration.errors.values())
    assert calibration.weights.temperature > 0
    assert calibration.made_with.differences(calibration.made_with) == ()
