"""The domains from Blender: its cloth on a moving body, its pictures from posed cameras, keyed masks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from toile.capture.data.blender import BlenderCloth, BlenderDomain, Cycles, Stage, Studio, Wild
from toile.capture.data.clips import PlannedClip, Truth
from toile.capture.data.filming import CameraRing
from toile.capture.data.own import CaptureSettings
from toile.capture.garments.garment import Garment
from toile.evaluation.penetration import penetration
from toile.evaluation.view_silhouettes import overlap_in_views
from toile.generation.blender.process import ENVIRONMENT, available
from toile.rendering.warp.renderer import WarpRenderer
from toile.scenes.views import MultiView

needs_blender = pytest.mark.skipif(not available(), reason=f"no bpy here nor in {ENVIRONMENT}")
BALL = trimesh.creation.icosphere(subdivisions=3, radius=0.2)
FACES = np.asarray(BALL.faces, dtype=np.int64)
N_FRAMES, FPS, SIDE = 8, 30.0, 11


class _Ball:
    """What a subject is here: a ball that rises by 10 cm a second."""

    faces = torch.from_numpy(FACES.copy())
    height = 1.0
    landmark_names = ("middle",)

    @staticmethod
    def landmarks(body: torch.Tensor) -> torch.Tensor:
        return body.mean(1, keepdim=True)


def sheet() -> Garment:
    """Above the ball, one corner fixed to the ball's topmost face."""
    at = torch.linspace(-0.3, 0.3, SIDE, dtype=torch.float64)
    x, z = torch.meshgrid(at, at, indexing="ij")
    k = torch.arange(SIDE * SIDE).reshape(SIDE, SIDE)
    a, b, c, d = (q.reshape(-1) for q in (k[:-1, :-1], k[1:, :-1], k[1:, 1:], k[:-1, 1:]))
    faces = torch.cat((torch.stack((a, c, b), 1), torch.stack((a, d, c), 1)))
    vertices = torch.stack(
        (x.reshape(-1), torch.full((SIDE * SIDE,), 1.01, dtype=torch.float64), z.reshape(-1)), 1
    )
    top = np.asarray(BALL.vertices)[FACES].mean(1)[:, 1].argmax()
    third = torch.full((1, 3), 1 / 3, dtype=torch.float64)
    middle = torch.tensor([SIDE * SIDE // 2])
    return Garment(
        vertices, faces, middle, torch.tensor([top]), third, torch.zeros(1, 3, dtype=torch.float64)
    )


class _Domain(BlenderDomain):
    """Ball and sheet instead of person and garment."""

    subject = _Ball()  # type: ignore[assignment]
    garment = true_garment = sheet()  # type: ignore[assignment]

    def body(self, plan: PlannedClip) -> torch.Tensor:
        rise = torch.arange(N_FRAMES, dtype=torch.float64) * 0.1 / FPS
        at = torch.from_numpy(np.asarray(BALL.vertices)) + torch.tensor([0.0, 0.8, 0.0])
        return at[None] + rise[:, None, None] * torch.tensor([0.0, 1.0, 0.0])


def domain(stage: Stage) -> _Domain:
    ring = CameraRing(views=2, side=48, distance=2.0, height=1.2, target=0.9, field_of_view=35.0)
    settings = CaptureSettings(n_frames=N_FRAMES, fps=FPS, ring=ring)
    return _Domain(settings, None, WarpRenderer(), stage, BlenderCloth(), Cycles(samples=2))  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def truth() -> Truth:
    if not available():
        pytest.skip(f"no bpy here nor in {ENVIRONMENT}")
    return domain(Studio()).truth(PlannedClip(0, "walk", 0))


def test_blenders_cloth_falls_hangs_and_stays_outside_the_body(truth: Truth) -> None:
    x = truth.garment_positions
    assert x.shape == (N_FRAMES, SIDE * SIDE, 3)
    # A corner of the sheet falls as free bodies do, a little less for air and cloth.
    fallen = x[0, 0, 1] - x[:, 0, 1]
    t = np.arange(N_FRAMES) / FPS
    assert fallen[4] == pytest.approx(0.5 * 9.81 * t[4] ** 2, rel=0.35)
    # What is fixed goes with the ball.
    middle = SIDE * SIDE // 2
    rise = truth.body_positions[:, :, 1].mean(1) - truth.body_positions[0, :, 1].mean()
    assert x[1:, middle, 1] - x[1, middle, 1] == pytest.approx(rise[1:] - rise[1], abs=1e-5)
    found = penetration(
        x, truth.garment_faces, truth.body_positions, truth.body_faces, held=np.array([middle])
    )
    assert found.maximum < 1e-3


def overlap(recording: MultiView, truth: Truth) -> torch.Tensor:
    x = torch.from_numpy(np.concatenate((truth.body_positions, truth.garment_positions), 1))
    faces = np.concatenate((truth.body_faces, truth.garment_faces + truth.body_positions.shape[1]))
    masks = [torch.stack([view.mask(f) for f in range(N_FRAMES)]) for view in recording.views]
    found = overlap_in_views(WarpRenderer(), recording.cameras, masks, x, torch.from_numpy(faces))
    return found.values


@pytest.mark.parametrize(("stage", "views"), [(Studio(), 2), (Wild(), 1)])
def test_pictures_and_masks_show_the_truth(truth: Truth, stage: Stage, views: int, tmp_path: Path) -> None:
    recording = domain(stage).film(PlannedClip(0, "walk", 0), truth, tmp_path)
    assert len(recording.views) == views
    assert overlap(recording, truth).min() > 0.93
    view = recording.views[0]
    outside = view.mask(0) + view.mask(7) < 0.5
    moved = (view.frame(0) - view.frame(7)).abs().mean(-1)[outside].mean()
    assert (moved > 0.05) == (views == 1)
    assert 0 < view.garment_mask(3).sum() < view.mask(3).sum()


def test_keying_finds_what_is_not_green_whatever_its_shade() -> None:
    image = np.zeros((40, 40, 4))
    image[10:30, 10:30] = [0.2, 0.05, 0.02, 1.0]
    image[10:30, 10:15, :3] = 0.01
    image[15:25, 20:24] = 0.0  # a gap, as between arm and body
    ((frame, mask),) = Studio().compose([image], 0.01, np.random.default_rng(0))
    assert (mask == (image[..., 3] > 0)).all()
    assert frame[0, 0].tolist() == pytest.approx([40, 170, 60], abs=12)


def test_the_sun_of_the_wild_moves_and_that_of_the_studio_does_not() -> None:
    for stage, moves in ((Wild(), True), (Studio(), False)):
        sun = stage.sun(5, np.random.default_rng(0))
        assert np.linalg.norm(sun, axis=1) == pytest.approx(np.ones(5))
        assert (np.ptp(sun, axis=0).max() > 0.1) == moves
