"""Where the print of a cloth is gone, and where it only looks different."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter
from torch import Tensor

from toile.diagnosis.occlusion import OcclusionSettings, hidden_shares, lasting
from toile.diagnosis.session_diagnosis import cover_of
from toile.diagnosis.session_weights import SessionWeights
from toile.reconstruction.problem import Reconstruction
from toile.scenes.scene import Scene

Hidden = Callable[..., np.ndarray]


@pytest.fixture
def scene(sharp_swaying_scene: Scene) -> Scene:
    return sharp_swaying_scene


@pytest.fixture
def truth(scene: Scene) -> np.ndarray:
    assert scene.ground_truth is not None
    assert scene.ground_truth.vertices is not None
    return scene.ground_truth.vertices.reshape(scene.n_frames, -1, 3).numpy().astype(np.float64)


@pytest.fixture
def hidden(problem: Callable[..., Reconstruction], scene: Scene, truth: np.ndarray) -> Hidden:
    """What is hidden of the scene, parts of which may be others, at the true positions or others."""

    def shares(positions: np.ndarray = truth, **changes: Tensor) -> np.ndarray:
        return hidden_shares(problem(scene=replace(scene, **changes)), positions)

    return shares


def disc(scene: Scene, radius: float, first: int = 3) -> tuple[Tensor, float]:
    """Frames in which a grey disc lies on the middle of the cloth from one on, and its share of the cloth."""
    frames = scene.frames.clone()
    rows, columns = np.nonzero(scene.masks[first].numpy() > 0.5)
    i, j = np.indices(frames.shape[1:3])
    inside = (i - rows.mean()) ** 2 + (j - columns.mean()) ** 2 < radius**2
    inside &= scene.masks[first].numpy() > 0.5
    frames[first:, torch.from_numpy(inside)] = torch.tensor([0.35, 0.4, 0.3], dtype=frames.dtype)
    return frames, inside.sum() / len(rows)


def test_a_disc_before_the_cloth_hides_about_what_it_covers(scene: Scene, hidden: Hidden) -> None:
    frames, share = disc(scene, 30.0)
    found = hidden(frames=frames)
    assert (found[:3] == 0).all()
    # Patches at its border, half of one wide, have some print left.
    assert (found[3:] > 0.35 * share).all()
    assert (found[3:] < share).all()
    smaller, _ = disc(scene, 16.0)
    less = hidden(frames=smaller)[3:]
    assert ((less > 0) & (less < 0.5 * found[3:])).all()


def test_light_and_blur_hide_nothing(scene: Scene, hidden: Hidden) -> None:
    across = torch.linspace(0.5, 1.1, scene.frames.shape[1], dtype=scene.frames.dtype)[:, None]
    darker = scene.frames.clone()
    darker[1:] = 0.7 * darker[1:] * across
    blurred = scene.frames.clone()
    blurred[1:] = torch.from_numpy(gaussian_filter(blurred[1:].numpy(), (0, 1.5, 4.0, 0)))
    for frames in (scene.frames, darker, blurred):
        assert hidden(frames=frames).max() == 0


def test_what_tracking_errs_by_hides_nothing(truth: np.ndarray, hidden: Hidden) -> None:
    wrong = truth.copy()
    wrong[1:] += np.array([0.02, -0.015, 0.03])  # some 5 px
    assert hidden(wrong).max() == 0


def test_what_the_mask_leaves_out_is_not_looked_for(scene: Scene, hidden: Hidden) -> None:
    frames, _ = disc(scene, 30.0)
    masks = scene.masks.clone()
    masks[(frames != scene.frames).any(-1)] = 0
    assert hidden(frames=frames, masks=masks).max() == 0


def test_a_cloth_without_a_print_says_nothing(scene: Scene, hidden: Hidden) -> None:
    frames, _ = disc(replace(scene, frames=torch.full_like(scene.frames, 0.7)), 30.0)
    assert hidden(frames=frames).max() == 0


def test_a_single_frame_does_not_last() -> None:
    flicker, stays = np.zeros(40), np.zeros(40)
    flicker[[7, 20, 21]] = 0.3
    stays[10:20] = 0.05
    assert lasting(flicker, 50.0).max() == 0
    assert lasting(stays, 50.0).sum() == pytest.approx(stays.sum())
    assert lasting(flicker, 50.0, OcclusionSettings(lasting=1.0)).max() == pytest.approx(0.3)


def test_frames_in_which_something_is_before_the_cloth() -> None:
    weights = SessionWeights()
    shares = np.zeros(40)
    shares[12:30] = 2 * weights.covered
    found = cover_of(shares, weights)
    assert found is not None
    assert (found.share, found.first, found.last) == (2 * weights.covered, 12, 29)
    assert cover_of(0.5 * shares, weights) is None
