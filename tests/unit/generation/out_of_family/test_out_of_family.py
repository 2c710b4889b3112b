"""The out-of-family generator: effects do something, matched scenes, labels that are true."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from toile.errors import InputError
from toile.generation.out_of_family.base_scene import draw_base, draw_motion
from toile.generation.out_of_family.catalogue import (
    INSIDE,
    OUT_OF_FAMILY_EFFECTS,
    OUTSIDE,
    out_of_family_effect,
)
from toile.generation.out_of_family.film import _moments
from toile.generation.out_of_family.interface import Measure, Reference, places_on
from toile.generation.out_of_family.making import (
    MadeScene,
    OutOfFamilySettings,
    SceneRequest,
    development_scene,
    make_scene,
    strength_of,
)
from toile.generation.out_of_family.optics import RaggedMask
from toile.generation.out_of_family.simulation import simulate_out_of_family
from toile.generation.simulation import Sheet
from toile.physics.cloth import grid_material
from toile.physics.implicit.newton import NewtonSettings
from toile.physics.simulator import SimulationError

SETUP = OutOfFamilySettings(
    grid=(7, 7),
    substeps=3,
    coarse_substeps=3,
    largest_grid_share=8.0,
    n_frames=8,
    image_side=48,
    texture_side=48,
    supersampling=1,
    blur_samples=3,
    templates=(),
)
NEWTON = NewtonSettings(tolerance=1e-6)
GRID, SIZE, FPS, N = (5, 6), (0.4, 0.5), 25.0, 7


def sheet() -> Sheet:
    u, v = (torch.linspace(0, s, n, dtype=torch.float64) for s, n in zip(SIZE, GRID, strict=True))
    x, y = torch.meshgrid(u, v, indexing="ij")
    pose = torch.stack((0.97 * x, y, 1 + 0.04 * torch.sin(9 * x) + 0.02 * torch.cos(5 * y)), -1)
    material = grid_material(*(torch.tensor([k], dtype=torch.float64) for k in (300.0, 2e-3, 2e-4)))
    return Sheet.of(pose, SIZE, 0.15, (0, (GRID[0] - 1) * GRID[1]), material)


def simulated(*effects, newton: NewtonSettings = NEWTON) -> torch.Tensor:
    motion = simulate_out_of_family(
        sheet(),
        effects,
        pinned_motion=draw_motion(np.random.default_rng(1)),
        gravity=torch.tensor([0.0, 9.81, 0.0], dtype=torch.float64),
        wind=torch.tensor([0.3, 0.0, 2.0], dtype=torch.float64),
        n_frames=N,
        fps=FPS,
        substeps=4,
        newton=newton,
    )
    return motion[::4]


@pytest.fixture(scope="module")
def twin() -> torch.Tensor:
    return simulated()


@pytest.fixture(scope="module")
def reference(twin: torch.Tensor) -> Reference:
    s = sheet()
    gravity = torch.tensor([0.0, 9.81, 0.0], dtype=torch.float64)
    return Reference(twin, SIZE, gravity, FPS, tuple(s.cloth.pinned.tolist()))


MOVING = [name for name, kind in OUT_OF_FAMILY_EFFECTS.items() if kind.MEASURE is Measure.MOTION]


@pytest.mark.parametrize("name", MOVING)
def test_effects_that_move_the_cloth(name, twin, reference) -> None:
    """Nothing without strength; more with more; frame 0 is that of the twin."""
    effect = out_of_family_effect(name)(np.random.default_rng(5), reference)
    gaps = []
    for strength in (0.0, 0.1 * effect.LIMIT, 0.5 * effect.LIMIT if effect.LIMIT < 5 else 2.0):
        motion = simulated(effect.scaled(strength))
        assert torch.equal(motion[0], twin[0])
        assert bool(motion.isfinite().all())
        gaps.append(float((motion - twin).norm(dim=-1).mean()))
    assert gaps[0] < 1e-7
    assert gaps[2] > 1e-6
    assert gaps[2] > gaps[0]


def test_a_step_that_fails_says_what_to_try() -> None:
    with pytest.raises(SimulationError, match=r"frame 1, .*another seed"):
        simulated(newton=NewtonSettings(tolerance=1e-12, max_iterations=1))


def test_drag_takes_energy(twin, reference) -> None:
    drag = out_of_family_effect("air_drag")(np.random.default_rng(5), reference)
    slow = simulated(drag.scaled(3.0))
    speed = [float(m.diff(dim=0)[1:].norm(dim=-1).mean()) for m in (slow, twin)]
    assert speed[0] < speed[1]


def test_shrinking_shortens_edges(twin, reference) -> None:
    shrunk = simulated(out_of_family_effect("shrinking")(np.random.default_rng(5), reference).scaled(4.0))
    length = [float(m[-1].diff(dim=1).norm(dim=-1).mean()) for m in (shrunk, twin)]
    assert length[0] < 0.99 * length[1]


def test_contact_stays_outside(twin, reference) -> None:
    contact = out_of_family_effect("contact")(np.random.default_rng(2), reference).scaled(0.9)
    assert float(contact._gap(twin.reshape(-1, 3))[0].min()) < -1e-3  # the twin would go through
    motion = simulated(contact)
    assert float(contact._gap(motion[0].reshape(-1, 3))[0].min()) > 0
    twin_depth = -float(contact._gap(twin.reshape(-1, 3))[0].min())
    assert -float(contact._gap(motion.reshape(-1, 3))[0].min()) < 0.5 * twin_depth


def test_slip_moves_one_corner_in_jumps(reference) -> None:
    slip = out_of_family_effect("anchor_slip")(np.random.default_rng(5), reference)
    times = torch.linspace(0, reference.duration, 200, dtype=torch.float64)
    path = slip.boundary(times)[:, slip.corner] @ slip.direction
    assert float(slip.boundary(times)[:, 1 - slip.corner].abs().max()) == 0.0
    assert float(path[0]) == 0.0
    assert float(path.diff().min()) > -1e-15
    assert slip.where(places_on(GRID)).any()


def test_names_are_those_of_the_catalogue() -> None:
    from toile.effects.catalogue import STAGES

    assert set(INSIDE) == set(STAGES)
    assert not set(OUTSIDE) & set(STAGES)
    for name in INSIDE:
        assert out_of_family_effect(name).STAGE is STAGES[name]
    with pytest.raises(InputError, match="ghost"):
        out_of_family_effect("ghost")


def test_base_scene_does_not_depend_on_the_effect() -> None:
    first, second = (draw_base(SETUP, np.random.default_rng([4, 0, 1])) for _ in range(2))
    assert first.describe() == second.describe()
    assert torch.equal(first.texture, second.texture)


def test_strength_of() -> None:
    found, size = strength_of(lambda s: 0.3 * s**2, 3.0, 100.0)
    assert size == pytest.approx(3.0, rel=0.15)
    assert found == pytest.approx(math.sqrt(10), rel=0.1)
    assert strength_of(lambda s: 0.1 * s, 3.0, 5.0) == (5.0, pytest.approx(0.5))


@pytest.fixture(scope="module")
def gusty() -> MadeScene:
    return development_scene("gusts", "strong", 2, SETUP)


def test_scene_and_label(gusty: MadeScene) -> None:
    scene, label = gusty.scene, gusty.label
    assert scene.ground_truth is None
    assert scene.frames.shape[0] == scene.masks.shape[0] == SETUP.n_frames
    assert max(scene.frames.shape[1:3]) == SETUP.image_side
    assert torch.equal(scene.template, gusty.vertices[0])
    assert torch.equal(gusty.vertices[0], gusty.twin[0])
    width = sum(scene.cloth_size) / 2
    gap = (gusty.vertices - gusty.twin)[5:].norm(dim=-1).mean() / width * 100
    assert label["magnitude"]["mean_last_third"] == pytest.approx(float(gap))
    assert label["effects"] == ["gusts"]
    assert label["stage"] == "actuation"
    assert 3.0 < label["magnitude"]["alone"]["gusts"]["value"] < 9.0
    # Vertices are where the texture coordinates say: the mask covers them.
    size = torch.tensor([scene.camera.width, scene.camera.height])
    seen = (scene.texture_coordinates * size).reshape(-1, 2).round().long()
    inner = seen.reshape(*scene.grid, 2)[1:-1, 1:-1].reshape(-1, 2)
    assert float(scene.masks[0][inner[:, 1], inner[:, 0]].mean()) == 1.0


def test_same_request_same_scene(gusty: MadeScene) -> None:
    again = development_scene("gusts", "strong", 2, SETUP)
    assert torch.equal(again.scene.frames, gusty.scene.frames)
    assert again.label == gusty.label


@pytest.fixture(scope="module")
def null() -> MadeScene:
    return development_scene("none", seed=2, setup=SETUP)


def test_null_has_no_gap(null: MadeScene) -> None:
    assert torch.equal(null.vertices, null.twin)
    assert null.label["effect"] == "none"
    assert null.label["stage_accept"] == ["none"]


@pytest.mark.parametrize(
    "name", ["focal_error", "lens_distortion", "shading", "motion_blur", "unmasked_occluder"]
)
def test_optical_effects_change_the_film_only(name, null: MadeScene) -> None:
    made = development_scene(name, "strong", 2, SETUP)
    assert torch.equal(made.vertices, null.vertices)
    assert made.scene.camera == null.scene.camera
    assert float((made.scene.frames - null.scene.frames).abs().mean()) > 3e-4


def test_mask_bias_moves_the_edge(null: MadeScene) -> None:
    made = development_scene("mask_bias", "strong", 2, SETUP)
    difference = made.scene.masks.sum((1, 2)) - null.scene.masks.sum((1, 2))
    growth = made.label["parameters"]["mask_bias"]["growth_px"]
    assert bool((difference.sign() == math.copysign(1, growth)).all())


def test_brightness_is_matched(null: MadeScene) -> None:
    made = development_scene("shading", "medium", 2, SETUP)
    means = [float(m.scene.frames[0].sum() / m.scene.masks[0].sum()) for m in (made, null)]
    assert means[0] == pytest.approx(means[1], rel=0.15)


def test_two_effects() -> None:
    made = make_scene(SETUP, SceneRequest("x", (("gusts", "medium"), ("shading", "medium")), 2))
    assert made.label["effect"] == "gusts+shading"
    assert set(made.label["stage_accept"]) == {"actuation", "appearance"}


def test_unknown_level() -> None:
    with pytest.raises(InputError, match="level"):
        make_scene(SETUP, SceneRequest("x", (("gusts", "huge"),), 2))


def test_grid_share_is_bounded() -> None:
    from toile.physics.simulator import SimulationError

    with pytest.raises(SimulationError, match="draws"):
        make_scene(replace(SETUP, largest_grid_share=0.0), SceneRequest("x", (), 2))


@pytest.mark.parametrize("substeps", [5, 7, 8])
@pytest.mark.parametrize("exposure", [0.3, 0.5, 0.9])
def test_a_frame_sees_all_of_its_exposure_and_no_more(substeps: int, exposure: float) -> None:
    """A box of that length: its spread is what blurs, in even frames as in odd ones."""
    for frame in (1, 2):
        moments = np.array(_moments(frame, substeps, 100, exposure, 7)) / substeps
        assert moments.mean() == pytest.approx(frame)
        # Of seven middles instead of all moments: 1 % less.
        assert np.sqrt(12) * moments.std() == pytest.approx(exposure, rel=0.011)
    assert _moments(0, substeps, 100, exposure, 7) == [0.0]
    # At its end the cloth is seen where it ends.
    assert max(_moments(3, substeps, 3 * substeps + 1, exposure, 7)) == 3 * substeps


@pytest.mark.parametrize("growth", [-7.0, -2.0, -1.0, 1.0, 3.0, 7.0])
def test_a_mask_grows_by_what_its_label_says(growth: float) -> None:
    bias = RaggedMask.__new__(RaggedMask)
    bias.sign, bias.strength, bias.pixels_per_percent, bias.seed = np.sign(growth), abs(growth), 1.0, 3
    inside = np.zeros((200, 200))
    inside[40:160, 40:160] = 1
    drawn = [np.sqrt(bias.mask(inside, frame).sum()) / 2 - 60 for frame in range(8)]
    assert np.mean(drawn) == pytest.approx(growth, abs=0.15)
