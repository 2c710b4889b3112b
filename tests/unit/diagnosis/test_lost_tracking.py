"""Tracking that loses the cloth, as its outline tells."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

from toile.diagnosis import tracked
from toile.diagnosis.tracked import CoarseTracking, track, track_once
from toile.reconstruction.gauss_newton.recipe import SlidingWindows, TrackingRecipe, TrackingStage
from toile.reconstruction.gauss_newton.unknowns import Priors
from toile.reconstruction.image_terms.texture_points import PointTermSettings
from toile.reconstruction.lost_cloth import LostClothGuard, first_lost, outline_overlap
from toile.reconstruction.problem import Reconstruction

Problem = Callable[[], Reconstruction]


@pytest.fixture
def truth(swaying_scene) -> np.ndarray:
    return swaying_scene.ground_truth.vertices.reshape(swaying_scene.n_frames, -1, 3).numpy()


def folded(positions: np.ndarray, frame: int) -> np.ndarray:
    """The cloth's lower third folded up behind the rest, from a frame on: points hide, the image stays."""
    out = positions.copy().reshape(len(positions), 8, 8, 3)
    out[frame:, :, 6:] = out[frame:, :, [4, 3]]
    out[frame:, :, 6:, 2] += 0.02
    return out.reshape(positions.shape)


def test_a_cloth_that_folds_over_is_lost(problem: Problem, truth: np.ndarray) -> None:
    right = outline_overlap(problem(), truth)
    assert (right > 0.95).all()
    assert first_lost(right) == len(truth)
    wrong = outline_overlap(problem(), folded(truth, 3))
    np.testing.assert_array_equal(wrong[:3], right[:3])
    assert (wrong[3:] < 0.85).all()
    assert first_lost(wrong) == 3


def test_a_fit_takes_the_share_that_is_asked_for(problem: Problem, truth: np.ndarray) -> None:
    wrong = torch.from_numpy(folded(truth, 3)).unflatten(1, (8, 8))
    assert LostClothGuard().first_lost(problem(), wrong) == 3
    assert LostClothGuard(least_overlap=0.1).first_lost(problem(), wrong) == len(truth)


def test_a_wrong_camera_loses_nothing() -> None:
    assert first_lost(np.array([0.77, 0.78, 0.75, 0.74])) == 4


def test_the_heavier_silhouette_is_that_of_the_first_pass(
    problem: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    stage = TrackingStage(
        SlidingWindows(3, 1, 1),
        PointTermSettings(16, 1.0, None, 4096.0, 50.0),
        Priors(10.0, 1.0, 2.0, 0.01, 3.0, None, None, walk=False),
        1,
        5,
        0.03,
        visibility=True,
        settle=False,
        discard_turbulence=False,
    )
    weights: list[tuple[float, float]] = []

    def noted(stages):
        recipe = TrackingRecipe(stages)
        weights.extend((s.term.blur, s.term.mask_weight) for s in recipe.stages)
        return recipe

    monkeypatch.setattr(tracked, "TrackingRecipe", noted)
    arguments = (TrackingRecipe({"track": stage}), CoarseTracking(blur=4.0, per_side=8), 4, lambda *_: None)
    found = [track_once(problem(), *arguments, factor) for factor in (1.0, 10.0)]
    assert {(4.0, 50.0), (4.0, 500.0), (1.0, 50.0)} == set(weights)
    assert np.abs(found[0] - found[1]).max() > 1e-6


def test_a_heavier_silhouette_is_tried_where_the_cloth_is_lost(
    problem: Problem, truth: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    reconstruction = problem()
    start = reconstruction.parameters.turbulence.detach().clone()
    results = {1.0: folded(truth, 3), 10.0: folded(truth, 4), 100.0: truth}
    tried: list[float] = []

    def once(reconstruction, recipe, coarse, used, report, mask_factor):
        tried.append(mask_factor)
        assert torch.equal(reconstruction.parameters.turbulence, start), "every try starts anew"
        with torch.no_grad():
            reconstruction.parameters.turbulence.add_(1.0)
        return results[mask_factor]

    monkeypatch.setattr(tracked, "track_once", once)
    recipe = TrackingRecipe({})

    def tracked_by(factors: tuple[float, ...], used: int) -> np.ndarray:
        tried.clear()
        with torch.no_grad():
            reconstruction.parameters.turbulence.copy_(start)
        return track(
            reconstruction, recipe, CoarseTracking(mask_factors=factors), used, lambda frame, share: None
        )

    np.testing.assert_array_equal(tracked_by((1.0, 10.0, 100.0), 5), truth)
    assert tried == [1.0, 10.0, 100.0]
    # What is lost after the fitted frames alone is no reason to try again: they must not have a say.
    np.testing.assert_array_equal(tracked_by((1.0, 10.0), 3), folded(truth, 3))
    assert tried == [1.0]
    # None keeps it: the one that keeps it longest.
    np.testing.assert_array_equal(tracked_by((10.0, 1.0), 5), folded(truth, 4))
    assert tried == [10.0, 1.0]


def test_how_much_of_the_outline_must_stay_is_a_setting() -> None:
    overlap = np.array([0.8, 0.75, 0.6, 0.3])
    assert first_lost(overlap) == 2
    assert first_lost(overlap, 0.5) == 3
    assert first_lost(overlap, 0.95) == 1
