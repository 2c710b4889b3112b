"""Sessions of the out-of-family generator: one cloth in several clips, on both laws."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from toile.effects.base import Scope
from toile.errors import InputError
from toile.generation.clip_plan import MOTIONS, ClipPlan
from toile.generation.out_of_family.base_scene import OutOfFamilySettings, draw_base, draw_motion
from toile.generation.out_of_family.catalogue import (
    INSIDE,
    OUT_OF_FAMILY_EFFECTS,
    forms_of,
    out_of_family_effect,
    scope_of,
)
from toile.generation.out_of_family.interface import Measure, Reference
from toile.generation.out_of_family.making import MadeScene, size_of, start_of
from toile.generation.out_of_family.sessions import SessionRequest, make_session, make_spare_clip
from toile.generation.out_of_family.simulation import simulate_out_of_family
from toile.generation.simulation import Sheet
from toile.physics.cloth import grid_material
from toile.physics.grid_laws import taut
from toile.physics.implicit.newton import NewtonSettings

SMALL = OutOfFamilySettings(
    grid=(7, 7),
    substeps=3,
    coarse_substeps=3,
    largest_grid_share=20.0,
    n_frames=8,
    image_side=48,
    texture_side=48,
    supersampling=1,
    blur_samples=3,
    templates=(),
)
GRID, SIZE, N = (5, 6), (0.4, 0.5), 7
CLIPS = (ClipPlan("release", 8, 25.0), ClipPlan("shake", 8, 25.0))
MOVING = [
    form
    for name, kind in OUT_OF_FAMILY_EFFECTS.items()
    for form in forms_of(name)
    if kind.MEASURE is Measure.MOTION
]
GRAVITY = torch.tensor([0.0, 9.81, 0.0], dtype=torch.float64)


def taut_motion(*effects) -> torch.Tensor:
    u, v = (torch.linspace(0, s, n, dtype=torch.float64) for s, n in zip(SIZE, GRID, strict=True))
    x, y = torch.meshgrid(u, v, indexing="ij")
    pose = torch.stack((0.97 * x, y, 1 + 0.04 * torch.sin(9 * x) + 0.02 * torch.cos(5 * y)), -1)
    material = grid_material(300.0, 8e-3, 2e-4)
    cloth = Sheet.of(pose, SIZE, 0.15, (0, (GRID[0] - 1) * GRID[1]), material, taut)
    motion = simulate_out_of_family(
        cloth,
        effects,
        pinned_motion=draw_motion(np.random.default_rng(1), 1),
        gravity=GRAVITY,
        wind=torch.tensor([0.3, 0.0, 2.0], dtype=torch.float64),
        n_frames=N,
        fps=25.0,
        substeps=4,
        newton=NewtonSettings(tolerance=1e-6),
    )
    return motion[::4]


@pytest.fixture(scope="module")
def twin() -> torch.Tensor:
    return taut_motion()


@pytest.mark.parametrize("form", MOVING, ids=lambda form: form.__name__)
def test_every_form_acts_on_the_taut_law(form, twin) -> None:
    reference = Reference(twin, SIZE, GRAVITY, 25.0, (0, (GRID[0] - 1) * GRID[1]))
    effect = form(np.random.default_rng(5), reference)
    gaps = [
        float((taut_motion(effect.scaled(s)) - twin).norm(dim=-1).mean())
        for s in (0.0, min(0.5 * form.LIMIT, 2.0))
    ]
    assert gaps[0] < 1e-7
    assert gaps[1] > 1e-6


def test_scopes_are_those_of_the_catalogue() -> None:
    assert scope_of("gusts") is scope_of("contact") is scope_of("anchor_slip") is Scope.CLIP
    assert scope_of("frame_rate") is Scope.DEVICE
    assert scope_of("air_drag") is scope_of("vortex_field") is Scope.CLOTH
    assert scope_of("unmasked_occluder") is Scope.CLIP


def test_sizes() -> None:
    drag, shading = out_of_family_effect("air_drag"), out_of_family_effect("shading")
    assert size_of(drag, 7.0) == 7.0
    assert size_of(shading, 3.0) == pytest.approx(shading.LEVELS[1])
    assert size_of(shading, "weak") == shading.LEVELS[0]
    with pytest.raises(InputError, match="size"):
        size_of(drag, -1.0)


@pytest.fixture(scope="module")
def dense() -> list[MadeScene]:
    return make_session(SMALL, SessionRequest("s", (("nonuniform_density", 3.0),), 4, CLIPS))


def test_one_cloth_in_all_clips(dense: list[MadeScene]) -> None:
    first, second = (made.label for made in dense)
    for key in ("cloth_size", "areal_density", "network_units", "law", "compression", "template"):
        assert first["base"][key] == second["base"][key]
    assert first["parameters"] == second["parameters"]
    assert first["base"]["wind"] != second["base"]["wind"]
    assert first["base"]["wind"] == [0.0, 0.0, 0.0]  # released
    assert first["session"]["motion"] == "release"
    assert first["levels"] == ["3 %"]
    assert dense[0].scene.camera.fx == pytest.approx(dense[1].scene.camera.fx)
    corners = dense[1].vertices.reshape(len(dense[1].vertices), -1, 3)[:, dense[1].scene.pinned_vertices]
    assert float((corners - corners[0]).norm(dim=-1).max()) > 1e-4
    still = dense[0].vertices.reshape(len(dense[0].vertices), -1, 3)[:, dense[0].scene.pinned_vertices]
    assert torch.equal(still, still[:1].expand_as(still))


def test_the_size_is_that_of_the_first_clip(dense: list[MadeScene]) -> None:
    assert 1.5 < dense[0].label["magnitude"]["mean_last_third"] < 6.0


def test_same_request_same_session_and_a_spare_clip(dense: list[MadeScene]) -> None:
    request = SessionRequest("s", (("nonuniform_density", 3.0),), 4, CLIPS[:1])
    again = make_session(SMALL, request)
    assert torch.equal(again[0].scene.frames, dense[0].scene.frames)
    session = dense[0].label["session"]
    spare = make_spare_clip(SMALL, request, CLIPS[1], session["attempt"], list(session["strengths"].values()))
    assert torch.equal(spare.scene.frames, dense[1].scene.frames)


def test_gusts_differ_from_clip_to_clip() -> None:
    first, second = make_session(SMALL, SessionRequest("s", (("gusts", 3.0),), 4, CLIPS))
    assert first.label["session"]["strengths"] == second.label["session"]["strengths"]
    assert first.label["parameters"] != second.label["parameters"]


def test_both_laws_and_forms_are_drawn() -> None:
    laws, forms = set(), set()
    for seed in range(4):
        request = SessionRequest("s", (("air_drag", 3.0),), seed, CLIPS[:1])
        label = make_session(SMALL, request)[0].label
        laws.add(label["base"]["law"])
        forms.add(label["session"]["forms"]["air_drag"])
    assert laws == {"angles", "taut"}
    assert forms == {"MixedDrag", "QuadraticDrag"}


def test_the_turned_cloth_is_held_by_its_other_corners() -> None:
    base = draw_base(SMALL, np.random.default_rng(3))
    upright, turned = start_of(base), start_of(replace(base, turned=True))
    H, W = SMALL.grid
    assert upright.pinned == (0, (H - 1) * W)
    assert turned.pinned == (0, W - 1)
    # Down is down, and the same side faces the camera.
    assert bool((turned.pose[1:, :, 1] > turned.pose[:-1, :, 1]).all())
    faces = [torch.linalg.cross(p[1, 0] - p[0, 0], p[0, 1] - p[0, 0])[2] for p in (upright.pose, turned.pose)]
    assert math.copysign(1, faces[0]) == math.copysign(1, faces[1])


@pytest.mark.parametrize("motion", sorted(MOTIONS))
def test_every_motion_can_be_made(motion: str) -> None:
    made = make_session(SMALL, SessionRequest("s", (), 3, (ClipPlan(motion, 8, 25.0),)))[0]
    assert made.label["effect"] == "none"
    assert float((made.vertices[-1] - made.vertices[0]).norm(dim=-1).max()) > 1e-4


def test_an_effect_that_is_none() -> None:
    with pytest.raises(InputError, match="ghost"):
        make_session(SMALL, SessionRequest("s", (("ghost", 3.0),), 3, CLIPS))
    assert "ghost" not in INSIDE
