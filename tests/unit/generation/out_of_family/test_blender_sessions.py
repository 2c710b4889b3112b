"""Sessions that Blender makes: one cloth, several clips."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from toile.errors import InputError
from toile.generation.blender import world
from toile.generation.blender.settings import BlenderSettings, random_settings
from toile.generation.clip_plan import ClipPlan
from toile.generation.out_of_family import from_blender
from toile.generation.out_of_family.from_blender import (
    can_make_clips,
    clip_settings,
    make_clips_with_blender,
    make_spare_clip_with_blender,
    why_no_blender,
)

CLIPS = (ClipPlan("release", 6, 50.0), ClipPlan("shake", 6, 50.0))


def settings(motion: str, effect: str = "none") -> BlenderSettings:
    effects = () if effect == "none" else ((effect, 3.0),)
    return clip_settings("s", effects, 7, 0, ClipPlan(motion), small=False)


def test_clips_share_the_cloth() -> None:
    release, shake, fan_off = settings("release"), settings("shake"), settings("fan_off")
    for name in ("cloth_size", "tension", "shear", "bending", "mass", "seed", "focal_length", "gravity"):
        assert getattr(release, name) == getattr(shake, name)
    assert np.array_equal(
        world.patch(replace(release, effect="nonuniform_stiffness"), (9, 9)),
        world.patch(replace(shake, effect="nonuniform_stiffness"), (9, 9)),
    )
    times = np.linspace(0, 1, 20)
    assert not world.pinned_displacement(release, times).any()
    assert world.pinned_displacement(shake, times).any()
    assert any(shake.wind)
    assert not any(fan_off.wind)
    assert not any(release.wind)
    assert not np.array_equal(world.pose(release, (9, 9)), world.pose(shake, (9, 9)))


def test_gusts_differ_from_clip_to_clip() -> None:
    first, second = settings("release", "gusts"), settings("shake", "gusts")
    assert not np.array_equal(world.gust_strength(first), world.gust_strength(second))


def test_single_scenes_are_as_before() -> None:
    single = random_settings(4)
    assert single.stream(1).random() == np.random.default_rng([4, 1]).random()


def test_what_blender_has_not() -> None:
    assert can_make_clips(())
    assert not can_make_clips((("gusts", 3.0), ("shading", 3.0)))
    assert not can_make_clips((("strain_stiffening", 3.0),))
    with pytest.raises(InputError, match="turned"):
        make_clips_with_blender("s", (), 1, (ClipPlan("turned"),))


def test_a_session_and_its_spare_clip(monkeypatch: pytest.MonkeyPatch) -> None:
    reason = why_no_blender()
    if reason:
        pytest.skip(f"no bpy for Blender scenes: {reason}")

    def tiny(seed: int, effect: str = "none", **_: object) -> BlenderSettings:
        return BlenderSettings(
            name="s",
            grid=(8, 8),
            steps=8,
            cloth_size=(0.5, 0.5),
            image_size=(64, 64),
            focal_length=65.0,
            distance=1.2,
            texture_size=64,
            samples=2,
            seed=seed,
            effect=effect,
        )

    monkeypatch.setattr(from_blender, "random_settings", tiny)
    effects = (("gravity_tilt", 0.5),)
    made = make_clips_with_blender("s", effects, 4, CLIPS)
    assert [m.label["session"]["motion"] for m in made] == ["release", "shake"]
    assert made[0].label["parameters"] == made[1].label["parameters"]
    assert made[0].label["levels"] == ["0.5 %"]
    assert made[0].scene.ground_truth is None
    session = made[0].label["session"]
    given = session["attempt"], session["strengths"]
    spare = make_spare_clip_with_blender("s", effects, 4, CLIPS[1], *given, steps=session["steps"])
    assert torch.equal(spare.vertices, made[1].vertices)


def test_all_clips_have_the_steps_that_one_of_them_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shorter steps damp less: by others a clip was of another cloth."""
    asked = []

    def needs(one: BlenderSettings, work: object, *, with_effect: bool) -> BlenderSettings:
        # What is let go askew needs twice the steps, and with the effect at its strength twice those again.
        least = 16 if one.clip == CLIPS[0].stream else 8
        least = 32 if with_effect and one.parameters.get("bend_factor") == 7.0 else least
        asked.append((one.steps, with_effect))
        return replace(one, steps=max(one.steps, least))

    def sized(first: BlenderSettings, effects: object) -> dict[str, float]:
        return {"bend_factor": 7.0}

    monkeypatch.setattr(from_blender, "balanced", needs)
    monkeypatch.setattr(from_blender, "_sized", sized)
    effects = (("nonuniform_stiffness", 3.0),)
    planned = [clip_settings("s", effects, 7, 0, plan, small=True) for plan in CLIPS]
    planned = [replace(one, steps=8) for one in planned]
    assert from_blender._of_all(planned, effects) == ({"bend_factor": 7.0}, 32)
    # Once more with all that were found, which is enough.
    assert asked[-2:] == [(32, True), (32, True)]
    still = [replace(one, effect="none") for one in planned]
    monkeypatch.setattr(from_blender, "_sized", lambda first, effects: {})
    assert from_blender._of_all(still, ()) == ({}, 16)
