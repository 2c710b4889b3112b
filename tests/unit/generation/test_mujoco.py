from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from toile.errors import InputError
from toile.generation.clip_plan import ClipPlan
from toile.generation.initial_pose import hanging_sheet
from toile.generation.motion import Still
from toile.generation.mujoco.clips import _Clip, last_third, resampled
from toile.generation.mujoco.drawing import (
    DrawnClip,
    MujocoSettings,
    draw_cloth,
    pinned_corners,
    unsettled_pose,
)
from toile.generation.mujoco.effects import MUJOCO_EFFECTS, mujoco_effect
from toile.generation.mujoco.engine import (
    Flex,
    FlexMaterial,
    FlexSheet,
    _model_text,
    settled_pose,
    simulate_flex,
    why_no_mujoco,
)
from toile.generation.out_of_family.base_scene import OutOfFamilySettings, RandomMotion
from toile.generation.out_of_family.blind_set import PlannedScene
from toile.generation.out_of_family.from_mujoco import (
    can_make,
    make_clips_with_mujoco,
    make_spare_clip_with_mujoco,
    make_with_mujoco,
)
from toile.generation.out_of_family.interface import OutOfFamilyEffect, Reference
from toile.generation.out_of_family.making import development_scene
from toile.geometry.mesh import grid_faces, vertex_normals
from toile.physics.simulator import SimulationError

pytestmark = pytest.mark.skipif(bool(why_no_mujoco()), reason=f"no MuJoCo: {why_no_mujoco()}")

GRID, SIZE, DENSITY = (9, 9), (0.5, 0.5), 0.15
MATERIAL = FlexMaterial(stretching=300.0, shearing=20.0, poisson=0.2, bending=2e-4, damping=5e-4)
SHEET = FlexSheet(GRID, SIZE, DENSITY, MATERIAL, pinned_corners(GRID, False))
DOWN = torch.tensor([0.0, 9.81, 0.0], dtype=torch.float64)
NO_WIND = torch.zeros(3, dtype=torch.float64)
SETUP = MujocoSettings(
    grid=(7, 7),
    vertices=(10, 10),
    coarse_vertices=(8, 8),
    largest_grid_share=20.0,
    image_side=48,
    texture_side=48,
    supersampling=1,
    blur_samples=3,
)


@pytest.fixture(scope="module")
def pose() -> torch.Tensor:
    loose = hanging_sheet(
        GRID, SIZE, pinned_distance=0.96, distance=1.1, yaw=0.2, gravity=(0.0, 9.81, 0.0), seed=2
    )
    return settled_pose(SHEET, loose, DOWN)


def simulated(pose: torch.Tensor, *effects: OutOfFamilyEffect, **changes) -> torch.Tensor:
    arguments = {"pinned_motion": Still(), "gravity": DOWN, "wind": NO_WIND, "n_frames": 11}
    return simulate_flex(SHEET, pose, effects, **{**arguments, "fps": 50.0, "substeps": 5, **changes})


def reference(pose: torch.Tensor, n_frames: int = 11) -> Reference:
    return Reference(pose.expand(n_frames, -1, -1, -1), SIZE, DOWN, 50.0, SHEET.pinned)


def effect(name: str, pose: torch.Tensor, seed: int = 0) -> OutOfFamilyEffect:
    return mujoco_effect(name)(np.random.default_rng(seed), reference(pose))


def test_a_settled_sheet_stays_where_it_is(pose):
    motion = simulated(pose, n_frames=26)
    assert (motion - pose).norm(dim=-1).max() < 1e-3 * SIZE[0]


def test_without_pins_it_falls_by_half_g_t_squared():
    sheet = replace(SHEET, pinned=())
    start = torch.from_numpy(Flex(sheet, 0.004, DOWN).rest).reshape(*GRID, 3)
    motion = simulate_flex(
        sheet, start, (), pinned_motion=Still(), gravity=DOWN, wind=NO_WIND, n_frames=11, fps=50, substeps=5
    )
    # Steps end with the new velocity: half a step ahead of the parabola.
    t = 0.2
    torch.testing.assert_close(
        motion[-1] - start, (0.5 * DOWN * t * (t + 0.004)).expand(*GRID, 3), rtol=1e-6, atol=1e-9
    )


def test_the_corners_carry_the_weight(pose):
    flex = Flex(SHEET, 0.004, DOWN)
    flex.place(pose.reshape(-1, 3).numpy())
    for _ in range(3):
        flex.step(np.zeros((len(flex.rest), 3)))
    assert flex.masses.sum() == pytest.approx(DENSITY * SIZE[0] * SIZE[1])
    np.testing.assert_allclose(flex.holding_force(), [0, -flex.masses.sum() * 9.81, 0], rtol=0.02, atol=0.01)


def test_the_corners_follow_their_path(pose):
    path = RandomMotion(((0.02, 0.0, 0.03),), (1.5,), (0.3,), 0.1)
    motion = simulated(pose, pinned_motion=path)
    times = 0.004 * torch.arange(len(motion), dtype=torch.float64)
    corners = motion.reshape(len(motion), -1, 3)[:, list(SHEET.pinned)]
    assert (corners - corners[:1] - path.displacement(times)[:, None]).abs().max() < 5e-5


def test_an_isotropic_sheet_is_the_one_that_the_engine_compiles():
    import mujoco

    isotropic = replace(MATERIAL, shearing=MATERIAL.stretching / (2 * (1 + MATERIAL.poisson)))
    flex = Flex(replace(SHEET, material=isotropic), 0.004, DOWN)
    compiled = mujoco.MjModel.from_xml_string(_model_text(flex.sheet, flex.rest, 0.004, DOWN, ()))
    np.testing.assert_allclose(flex.model.flex_stiffness, compiled.flex_stiffness, rtol=1e-9, atol=1e-9)


def test_a_stretched_strip_pulls_back_by_its_modulus():
    flex = Flex(replace(SHEET, pinned=()), 0.004, NO_WIND)
    flex.set_stiffness(replace(MATERIAL, poisson=0.0).plane_stiffness(4.0))
    strain = 1e-4
    for axis, modulus in ((0, 2 * 300.0), (1, 0.5 * 300.0)):
        stretched = flex.rest.copy()
        stretched[:, axis] *= 1 + strain
        flex.place(stretched)
        flex._mujoco.mj_forward(flex.model, flex.data)
        forces = flex.data.qfrc_passive.reshape(*GRID, 3)
        edge = forces[-1, :, 0] if axis == 0 else forces[:, -1, 1]
        assert -edge.sum() == pytest.approx(modulus * strain * SIZE[1 - axis], rel=1e-3)
        np.testing.assert_allclose(flex.strains(), strain, rtol=1e-3)


def test_the_null_clip_is_its_own_twin_bit_for_bit(null_scene):
    assert torch.equal(null_scene.vertices, null_scene.twin)
    again = make_clips_with_mujoco("null", (), 5, (ClipPlan("shake", 6),), setup=SETUP)[0]
    assert torch.equal(again.vertices, null_scene.vertices)
    assert torch.equal(again.scene.frames, null_scene.scene.frames)
    assert again.label == null_scene.label


def test_a_gust_moves_the_cloth_its_way(pose):
    gust = effect("gusts", pose).scaled(3.0)
    gust.begins, gust.lengths, gust.angles, gust.weights = (
        np.array([0.0]),
        np.array([0.4]),
        np.array([0.5 * np.pi]),
        np.array([1.0]),
    )
    gap = (simulated(pose, gust) - simulated(pose))[-1].mean((0, 1))
    assert gap[2] > 0.005  # away from the camera
    assert gap[2] > 3 * gap[0].abs()


def test_drag_and_damping_take_energy_away(pose):
    path = RandomMotion(((0.0, 0.0, 0.03),), (2.0,), (0.0,), 0.1)
    wind = torch.tensor([0.0, 0.0, 4.0], dtype=torch.float64)

    def speed(*effects: OutOfFamilyEffect) -> float:
        motion = simulated(pose, *effects, pinned_motion=path, wind=wind)
        return float(motion.diff(dim=0).square().mean())

    free = speed()
    assert speed(effect("air_drag", pose).scaled(10.0)) < 0.9 * free
    assert speed(effect("internal_damping", pose).scaled(20.0)) < 0.9 * free


def test_a_heavy_stripe_is_heavy_where_it_says(pose):
    stripe = effect("nonuniform_density", pose)
    places = torch.from_numpy(Flex(SHEET, 0.004, DOWN).places)
    ratio = stripe.scaled(2.0).masses(torch.ones(len(places), dtype=torch.float64), places)
    assert ratio[~stripe.where(places)].max() < 1.7
    assert 2.5 < ratio.max() <= 3.0


def test_shrinking_and_stiffening_lift_the_lower_edge(pose):
    for name, strength in (("shrinking", 5.0), ("strain_stiffening", 30.0)):
        other = effect(name, pose).scaled(strength)
        if name == "shrinking":
            other.span = np.array([0.0, 0.1])
        gap = (simulated(pose, other) - simulated(pose))[-1][:, -1, 1].mean()
        assert gap < -1e-4, name


def test_a_curled_hem_bends_towards_its_side(pose):
    hem = effect("rest_curvature", pose).scaled(4.0)
    hem.axis, hem.inner, hem.curvature = 1, 0.5, 8.0
    moved = simulated(pose, hem)[-1] - simulated(pose)[-1]
    normals = vertex_normals(pose.reshape(-1, 3), grid_faces(*GRID)).reshape(*GRID, 3)
    out = (moved * normals).sum(-1)
    # Towards the normals at the free edge, the other way where the bend begins.
    assert out[2:-2, -1].mean() > 1e-4
    assert out[2:-2, -1].mean() > out[2:-2, 5].mean()


def test_a_ball_in_the_way_is_not_entered(pose):
    wind = torch.tensor([0.0, 0.0, 5.0], dtype=torch.float64)
    free = simulated(pose, wind=wind)
    known = replace(reference(pose), motion=free[::5])
    ball = next(
        b
        for seed in range(20)
        if (b := mujoco_effect("contact")(np.random.default_rng(seed), known).scaled(0.8)).ball
    )
    touched = simulated(pose, ball, wind=wind)
    centre = ball.centre + (1 - 0.8) * ball.range * ball.normal
    assert ((free - centre).norm(dim=-1) - ball.radius).min() < -1e-3
    assert ((touched - centre).norm(dim=-1) - ball.radius).min() > -1e-3


@pytest.mark.parametrize("friction", [0.1, 0.3, 0.9])
def test_a_free_sheet_slides_down_a_slope_by_coulombs_law(friction):
    """The friction of the label acts, not the larger one of the cloth: above tan 30° it holds."""
    sheet = replace(SHEET, pinned=())
    flat = torch.from_numpy(Flex(sheet, 0.004, DOWN).rest).reshape(*GRID, 3)
    down, along = vertex_normals(flat.reshape(-1, 3), grid_faces(*GRID))[0], flat[-1, 0] - flat[0, 0]
    along = along / along.norm()
    slope = effect("contact", flat)
    slope.ball, slope.normal, slope.friction = False, down, friction
    slope.offset = float((flat[0, 0] * down).sum()) + 0.002
    tilt = np.radians(30.0)
    gravity = 9.81 * (np.sin(tilt) * along + np.cos(tilt) * down)
    motion = simulate_flex(
        sheet,
        flat,
        (slope.scaled(1.0),),
        pinned_motion=Still(),
        gravity=gravity,
        wind=NO_WIND,
        n_frames=11,
        fps=50.0,
        substeps=5,
    )
    slid = ((motion[-1] - flat) @ along).mean()
    pull = max(np.sin(tilt) - friction * np.cos(tilt), 0.0)
    # Until it lies on the slope, 2 mm below, nothing holds it.
    assert float(slid) == pytest.approx(0.5 * 9.81 * pull * 0.2**2, abs=3e-3)


def test_a_slipping_corner_ends_where_its_label_says(pose):
    slip = effect("anchor_slip", pose)
    far = slip.boundary(torch.tensor([0.0, 100.0], dtype=torch.float64))
    assert torch.equal(far[0], torch.zeros(2, 3, dtype=torch.float64))
    moved = far[1, slip.corner].norm()
    assert float(moved) == pytest.approx(slip.parameters()["slip"], rel=1e-3)
    assert torch.equal(far[1, 1 - slip.corner], torch.zeros(3, dtype=torch.float64))


def test_splines_keep_what_is_smooth():
    u = torch.linspace(0, 1, 12, dtype=torch.float64)
    fine = torch.stack(torch.meshgrid(u, u, indexing="ij"), -1)
    coarse = resampled(fine**2, (7, 5))
    v, w = torch.linspace(0, 1, 7, dtype=torch.float64), torch.linspace(0, 1, 5, dtype=torch.float64)
    torch.testing.assert_close(coarse, torch.stack(torch.meshgrid(v, w, indexing="ij"), -1) ** 2)


def test_turned_by_a_quarter_and_not_mirrored():
    cloth = replace(draw_cloth(np.random.default_rng(0)), gravity=(0.0, 9.81, 0.0), yaw=0.0)
    clip = DrawnClip(Still(), False, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 1)
    for turned in (False, True):
        sheet = unsettled_pose(cloth, replace(clip, turned=turned), (6, 7))
        assert sheet.shape == (6, 7, 3)
        first, second = sheet[-1, 3] - sheet[0, 3], sheet[3, -1] - sheet[3, 0]
        # Seen from the same side: axis 0, axis 1 and the line of sight keep their handedness.
        assert torch.linalg.cross(first, second)[2] > 0
        heights = sheet.reshape(-1, 3)[list(pinned_corners((6, 7), turned)), 1]
        assert heights.max() <= sheet[..., 1].min() + 1e-9


@pytest.fixture(scope="module")
def null_scene():
    return make_clips_with_mujoco("null", (), 5, (ClipPlan("shake", 6),), setup=SETUP)[0]


@pytest.fixture(scope="module")
def session():
    effects = (("nonuniform_density", 3.0), ("gusts", 3.0))
    return make_clips_with_mujoco("s", effects, 3, (ClipPlan("release", 8), ClipPlan("sway", 8)), setup=SETUP)


def test_labels_have_the_keys_of_the_own_generator(null_scene, session):
    setup = OutOfFamilySettings(
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
    own = development_scene("none", seed=2, setup=setup).label
    for label in (null_scene.label, session[0].label):
        assert label.keys() == {*own, "session"}
        assert label["magnitude"].keys() == own["magnitude"].keys()
        assert label["localisation"].keys() == own["localisation"].keys()
        assert label["generator"] == "mujoco"


def test_clips_of_a_session_share_the_cloth_and_redraw_the_gusts(session):
    first, second = session
    assert first.scene.camera.fx == second.scene.camera.fx
    assert first.label["base"]["material"] == second.label["base"]["material"]
    assert first.label["base"]["wind"] != second.label["base"]["wind"]
    parameters = [made.label["parameters"] for made in session]
    assert parameters[0]["nonuniform_density"] == parameters[1]["nonuniform_density"]
    assert parameters[0]["gusts"]["angles"] != parameters[1]["gusts"]["angles"]
    for made in session:
        assert last_third(made.vertices, made.twin, 1.0) > 0


def test_a_clip_can_be_made_later(session):
    effects = (("nonuniform_density", 3.0), ("gusts", 3.0))
    told = session[0].label["session"]
    strengths = [told["strengths"][name] for name, _ in effects]
    first = (ClipPlan("release", 8),)
    later = make_spare_clip_with_mujoco(
        "s", effects, 3, first, ClipPlan("sway", 8), told["attempt"], strengths, setup=SETUP
    )
    assert torch.equal(later.vertices, session[1].vertices)
    assert torch.equal(later.scene.frames, session[1].scene.frames)


def test_a_planned_scene_has_the_size_of_its_level():
    planned = PlannedScene("p", (("gravity_tilt", "medium"),), 4, "mujoco")
    assert can_make(planned)
    made = make_with_mujoco(planned, n_frames=12, targets={"medium": 2.0}, setup=SETUP)
    assert made.label["magnitude"]["mean_last_third"] == pytest.approx(2.0, rel=0.4)
    assert made.scene.ground_truth is None
    assert made.vertices.shape == (12, 7, 7, 3)


def test_a_clip_that_a_coarse_grid_cannot_follow_is_drawn_anew():
    strict = replace(SETUP, largest_grid_share=1e-4)
    cloth = draw_cloth(np.random.default_rng(0))
    with pytest.raises(SimulationError, match="strays"):
        _Clip(strict, cloth, ClipPlan("release", 6), np.random.default_rng(1))


def test_what_it_does_not_know_is_said():
    assert not can_make(PlannedScene("p", (("plastic_creases", "weak"),), 1, "mujoco"))
    assert all(can_make(PlannedScene("p", ((name, "weak"),), 1)) for name in MUJOCO_EFFECTS)
    with pytest.raises(InputError, match="no such effect"):
        make_clips_with_mujoco("p", (("plastic_creases", 1.0),), 1)
    with pytest.raises(InputError, match="size"):
        make_clips_with_mujoco("p", (("gusts", 0.0),), 1)
    with pytest.raises(InputError, match="level"):
        make_with_mujoco(PlannedScene("p", (("gusts", "huge"),), 1))


def test_without_the_package_one_clear_message(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    assert why_no_mujoco()
    with pytest.raises(InputError, match=r"toile\[mujoco\]"):
        make_clips_with_mujoco("p", (), 1)
