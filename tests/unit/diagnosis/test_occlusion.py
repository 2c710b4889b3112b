"""Where the print of a cloth is gone, and where it only looks different."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter
from torch import Tensor

from toile.diagnosis.occlusion import OcclusionSettings, hidden_shares, lasting
from toile.diagnosis.session_diagnosis import cover_of
from toile.diagnosis.session_weights import SessionWeights
from toile.generation.generator import GeneratorSettings, generate
from toile.generation.textures import procedural_texture
from toile.physics.implicit.integrators import BDF2
from toile.physics.implicit.newton import NewtonSettings
from toile.physics.implicit.simulator import ImplicitSimulator
from toile.reconstruction.parameters import ClothParameters
from toile.reconstruction.problem import Reconstruction
from toile.reconstruction.scene_cloth import scene_cloth, scene_units, template
from toile.rendering import WarpRenderer
from toile.scenes.scene import Scene

FRAMES = 6
SIZE = 192


@pytest.fixture(scope="module")
def scene() -> Scene:
    settings = GeneratorSettings(
        name="swaying",
        grid=(8, 8),
        refinement=1,
        substeps=4,
        n_frames=FRAMES,
        image_size=(SIZE, SIZE),
        focal_length=288.0,
        cloth_size=(0.6, 0.6),
        bending=2.0,
        initial_wind=(0.5, 0.0, -1.0),
        wind=(-0.3, 0.0, 1.5),
        pinned_distance=0.96,
        distance=1.1,
    )
    return generate(settings, procedural_texture(256, 256, seed=0))[0]


@pytest.fixture(scope="module")
def truth(scene: Scene) -> np.ndarray:
    assert scene.ground_truth is not None
    assert scene.ground_truth.vertices is not None
    return scene.ground_truth.vertices.reshape(FRAMES, -1, 3).numpy().astype(np.float64)


def problem(scene: Scene, frames: Tensor | None = None) -> Reconstruction:
    if frames is not None:
        scene = replace(scene, frames=frames)
    cloth = scene_cloth(scene, 0.15, template)
    units = scene_units(scene, 0.15)
    parameters = ClothParameters(
        FRAMES, cloth.n_vertices, len(cloth.pinned), units, stretching=3000.0, shearing=8.0, bending=0.5
    )
    return Reconstruction(
        scene,
        cloth,
        lambda cloth, step: ImplicitSimulator(cloth, step, BDF2(), NewtonSettings()),
        2,
        parameters,
        WarpRenderer(),
    )


def disc(scene: Scene, radius: float, first: int = 3) -> tuple[Tensor, float]:
    """Frames in which a grey disc lies on the middle of the cloth from one on, and its share of the cloth."""
    frames = scene.frames.clone()
    rows, columns = np.nonzero(scene.masks[first].numpy() > 0.5)
    i, j = np.mgrid[:SIZE, :SIZE]
    inside = (i - rows.mean()) ** 2 + (j - columns.mean()) ** 2 < radius**2
    inside &= scene.masks[first].numpy() > 0.5
    frames[first:, torch.from_numpy(inside)] = torch.tensor([0.35, 0.4, 0.3], dtype=frames.dtype)
    return frames, inside.sum() / len(rows)


def test_a_disc_before_the_cloth_hides_about_what_it_covers(scene: Scene, truth: np.ndarray) -> None:
    frames, share = disc(scene, 30.0)
    found = hidden_shares(problem(scene, frames), truth)
    assert (found[:3] == 0).all()
    # Patches at its border, half of one wide, have some print left.
    assert (found[3:] > 0.35 * share).all()
    assert (found[3:] < share).all()
    smaller, _ = disc(scene, 16.0)
    less = hidden_shares(problem(scene, smaller), truth)[3:]
    assert ((less > 0) & (less < 0.5 * found[3:])).all()


def test_light_and_blur_hide_nothing(scene: Scene, truth: np.ndarray) -> None:
    across = torch.linspace(0.5, 1.1, SIZE, dtype=scene.frames.dtype)[:, None]
    darker = scene.frames.clone()
    darker[1:] = 0.7 * darker[1:] * across
    blurred = scene.frames.clone()
    blurred[1:] = torch.from_numpy(gaussian_filter(blurred[1:].numpy(), (0, 1.5, 4.0, 0)))
    for frames in (None, darker, blurred):
        assert hidden_shares(problem(scene, frames), truth).max() == 0


def test_what_tracking_errs_by_hides_nothing(scene: Scene, truth: np.ndarray) -> None:
    wrong = truth.copy()
    wrong[1:] += np.array([0.02, -0.015, 0.03])  # some 5 px
    assert hidden_shares(problem(scene), wrong).max() == 0


def test_what_the_mask_leaves_out_is_not_looked_for(scene: Scene, truth: np.ndarray) -> None:
    frames, _ = disc(scene, 30.0)
    masks = scene.masks.clone()
    masks[(frames != scene.frames).any(-1)] = 0
    known = replace(scene, masks=masks)
    assert hidden_shares(problem(known, frames), truth).max() == 0


def test_a_cloth_without_a_print_says_nothing(scene: Scene, truth: np.ndarray) -> None:
    frames, _ = disc(replace(scene, frames=torch.full_like(scene.frames, 0.7)), 30.0)
    assert hidden_shares(problem(scene, frames), truth).max() == 0


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
