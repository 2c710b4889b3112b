"""Scenes of a blind set that Blender makes, in the shape of those of our own generator."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from toile.errors import InputError
from toile.generation.blender import process
from toile.generation.blender.balance import balanced
from toile.generation.blender.effects import EFFECTS, WITHIN, effect_named
from toile.generation.blender.scene import TWIN_FILE, blender_scene, matched
from toile.generation.blender.settings import BlenderSettings, random_settings
from toile.generation.clip_plan import ClipPlan
from toile.generation.out_of_family.blind_set import PlannedScene
from toile.generation.out_of_family.catalogue import (
    LEVELS,
    OUT_OF_FAMILY_EFFECTS,
    out_of_family_effect,
)
from toile.generation.out_of_family.interface import Measure
from toile.generation.out_of_family.making import SIZES, MadeScene
from toile.physics.simulator import SimulationError
from toile.scenes.native import load_native

_ATTEMPTS = 6
_SMALLEST_SHARES = (0.6,) * 3 + (0.3,) * 2 + (0.0,)
"""Of the size that was asked for, by attempt; with less, another session is drawn."""


def why_no_blender() -> str:
    """Why Blender cannot make scenes here; "" where it can."""
    try:
        process.interpreter()
    except InputError as error:
        return error.got
    return ""


def can_make(planned: PlannedScene) -> bool:
    """Whether Blender has what is planned: no effect, or one that it knows."""
    if len(planned.effects) > 1:
        return False
    try:
        effect_named(planned.effects[0][0] if planned.effects else "none")
    except InputError:
        return False
    return True


def make_with_blender(planned: PlannedScene, *, small: bool = False) -> MadeScene:
    """Make a planned scene with Blender; other seeds follow where one cannot be made.

    Args:
        planned: with at most one effect.
        small: see blender.settings.random_settings.

    Raises:
        InputError: bpy is missing, or no seed of several gives a scene.
    """
    name, level = planned.effects[0] if planned.effects else ("none", "")
    last: Exception | None = None
    for attempt in range(_ATTEMPTS):
        seed = (planned.seed + attempt) % 2**31
        settings = random_settings(seed, name, name=planned.name, small=small)
        try:
            if name != "none" and out_of_family_effect(name).MEASURE is Measure.MOTION:
                gap = out_of_family_effect(name).LEVELS[LEVELS.index(level)] / 100
                settings = matched(settings, gap)
            elif name != "none":
                # Optical effects have no size in the motion; the level scales their usual numbers.
                factor = (0.5, 1.0, 2.0)[LEVELS.index(level)]
                scaled = effect_named(name).scaled
                if scaled is not None:
                    value = settings.values[scaled] * factor
                    settings = replace(settings, parameters={scaled: value})
            return _made(settings, planned.effects)
        except process.BlenderError:
            raise
        except (InputError, ArithmeticError, RuntimeError) as error:
            last = error
    raise InputError("Blender makes no such scene", where=planned.name, expected="a scene", got=str(last))


def can_make_clips(effects: Sequence[tuple[str, float]]) -> bool:
    """Whether Blender has some effects, installed or not: none, or one that it knows."""
    return not effects or (len(effects) == 1 and effects[0][0] in EFFECTS)


def make_clips_with_blender(
    name: str,
    effects: Sequence[tuple[str, float]],
    seed: int,
    clips: Sequence[ClipPlan],
    *,
    small: bool = False,
) -> list[MadeScene]:
    """Several clips of one cloth: the same material, print, camera and patterns of cloth and device.

    Args:
        name: of the session.
        effects: (name, size) pairs, at most one; size as ``making.size_of`` takes it, in the first clip.
        seed: of everything random.
        clips: none of them turned: Blender's cloth hangs from one pair of corners.
        small: see blender.settings.random_settings.

    Raises:
        InputError: bpy is missing, more than one effect, a clip that is turned, or no seed of several gives a
            session.
    """
    last: Exception | None = None
    for attempt in range(_ATTEMPTS):
        try:
            planned = [clip_settings(name, effects, seed, attempt, plan, small=small) for plan in clips]
            parameters, steps = _of_all(planned, effects)
            made = [_clip(name, effects, seed, attempt, clips[0], parameters, steps, small)]
            _check_size(made[0], effects, _SMALLEST_SHARES[attempt])
            made += [
                _clip(name, effects, seed, attempt, plan, parameters, steps, small) for plan in clips[1:]
            ]
        except process.BlenderError:
            raise
        except (ArithmeticError, RuntimeError) as error:
            last = error
        except InputError as error:
            if error.where in ("effects", "clips"):
                raise
            last = error
        else:
            return made
    raise InputError("Blender makes no such session", where=name, expected="a session", got=str(last))


def make_spare_clip_with_blender(
    name: str,
    effects: Sequence[tuple[str, float]],
    seed: int,
    plan: ClipPlan,
    attempt: int,
    strengths: Mapping[str, Mapping[str, float]],
    *,
    steps: int | None = None,
    small: bool = False,
) -> MadeScene:
    """One more clip of a session that has been made.

    Args:
        name: as for make_clips_with_blender.
        effects: as for make_clips_with_blender.
        seed: as for make_clips_with_blender.
        plan: of the clip.
        attempt: as the labels of the session say.
        strengths: as the labels of the session say.
        steps: as the labels of the session say; None where they do not, for as many as this clip needs.
        small: as for make_clips_with_blender.

    Raises:
        InputError: bpy is missing, or the clip cannot be made.
        SimulationError: it needs more steps than the session has.
    """
    parameters = dict(strengths[effects[0][0]]) if effects else {}
    return _clip(name, effects, seed, attempt, plan, parameters, steps, small)


def _clip(
    name: str,
    effects: Sequence[tuple[str, float]],
    seed: int,
    attempt: int,
    plan: ClipPlan,
    parameters: Mapping[str, float],
    steps: int | None,
    small: bool,
) -> MadeScene:
    settings = clip_settings(name, effects, seed, attempt, plan, small=small)
    settings = replace(settings, parameters=dict(parameters), steps=steps or settings.steps)
    levels = tuple((effect, f"{size:g} %") for effect, size in effects)
    made = _made(settings, levels)
    taken = int(made.label["settings"]["steps"])
    if steps is not None and taken != steps:
        raise SimulationError(f"{plan.motion} needs {taken} steps a frame, the session has {steps}")
    session = {
        "motion": plan.motion,
        "attempt": attempt,
        "steps": taken,
        "strengths": {effect: dict(parameters) for effect, _ in effects},
        "forms": {effect: "blender" for effect, _ in effects},
    }
    return replace(made, label={**made.label, "session": session})


def _of_all(
    clips: Sequence[BlenderSettings], effects: Sequence[tuple[str, float]]
) -> tuple[dict[str, float], int]:
    """Parameters of the effect, and steps a frame in which all clips keep the balance of torques.

    All have the same: shorter steps damp less, and by another damping a clip is of another cloth (1 % of the
    width and more between 8 and 32 steps).
    """
    with tempfile.TemporaryDirectory(prefix="toile-blender-") as scratch:

        def needed(sized: Sequence[BlenderSettings], *, with_effect: bool) -> int:
            return max(balanced(one, Path(scratch), with_effect=with_effect).steps for one in sized)

        steps = needed(clips, with_effect=False)
        while True:
            parameters = _sized(replace(clips[0], steps=steps), effects)
            sized = [replace(one, steps=steps, parameters=parameters) for one in clips]
            more = needed(sized, with_effect=True) if sized[0].effect in WITHIN else steps
            if more == steps:
                return parameters, steps
            steps = more


def clip_settings(
    name: str,
    effects: Sequence[tuple[str, float]],
    seed: int,
    attempt: int,
    plan: ClipPlan,
    *,
    small: bool = False,
) -> BlenderSettings:
    """The session's cloth and camera with what is drawn for a clip; its effect of usual strength.

    Args:
        name: as for make_clips_with_blender.
        effects: as for make_clips_with_blender.
        seed: as for make_clips_with_blender.
        plan: of the clip.
        attempt: further ones are other sessions.
        small: as for make_clips_with_blender.

    Raises:
        InputError: more than one effect, or a clip that is turned.
    """
    if len(effects) > 1 or plan.motion == "turned":
        raise InputError(
            "Blender makes no such session",
            where="effects" if len(effects) > 1 else "clips",
            expected="at most one effect, and no turned clip",
            got=plan.motion if len(effects) < 2 else ", ".join(n for n, _ in effects),
        )
    base = random_settings(
        (seed + attempt) % 2**31, effects[0][0] if effects else "none", name=name, small=small
    )
    rng = np.random.default_rng([base.seed, 10, *plan.stream])
    lean, wind, towards = rng.uniform(0.1, 0.3), rng.uniform(0, 1), rng.uniform(0, 2 * math.pi)
    small_motion = float(rng.uniform(0.006, 0.014))
    speed = {"hang": 2000 + 3000 * wind, "shake": 2500 * wind, "sway": 2500 * wind}.get(plan.motion, 0.0)
    down = np.array(base.gravity) / np.linalg.norm(base.gravity)
    ahead = np.cross([1.0, 0.0, 0.0], down)
    blowing = speed * (math.cos(towards) * np.array([1.0, 0.0, 0.0]) + math.sin(towards) * ahead)
    shaken = plan.motion in ("shake", "fan_off")
    still = plan.motion in ("hang", "release")
    return replace(
        base,
        clip=plan.stream,
        n_frames=plan.n_frames,
        fps=plan.fps,
        # As long as in single scenes.
        steps=max(round(base.steps * base.fps / plan.fps), 2),
        # It hangs askew where it is let go, and nearly upright where it is moved.
        pitch=base.pitch if plan.motion == "release" else float(lean) * base.pitch,
        motion_amplitude=0.0 if still else small_motion if shaken else base.motion_amplitude,
        motion_rate=1.8 if shaken else 0.7,
        wind=(float(blowing[0]), float(blowing[1]), float(blowing[2])),
    )


def _sized(first: BlenderSettings, effects: Sequence[tuple[str, float]]) -> dict[str, float]:
    """Parameters of the effect with which it is as large as asked for in the first clip."""
    if not effects:
        return {}
    name, size = effects[0]
    known = out_of_family_effect(name) if name in OUT_OF_FAMILY_EFFECTS else None
    if known is None or known.MEASURE is Measure.MOTION:
        return dict(matched(first, size / 100).parameters)
    # Of the image: half, once or twice its usual numbers.
    factor = float(np.exp(np.interp(math.log(size), np.log(SIZES), np.log((0.5, 1.0, 2.0)))))
    usual = first.values
    match name:
        case "motion_blur":
            return {"shutter": min(factor * usual["shutter"], 1.0)}
        case "shading":
            lambert = min(factor * usual["lambert"], 0.9)
            return {"lambert": lambert, "ambient": usual["ambient"] + usual["lambert"] - lambert}
        case _:
            main = next(iter(usual))
            return {main: factor * usual[main]}


def _check_size(made: MadeScene, effects: Sequence[tuple[str, float]], share: float) -> None:
    """Raise SimulationError where an effect whose strength can be chosen is much too small."""
    if not effects or effect_named(effects[0][0]).scaled is None:
        return
    reached = made.label["magnitude"]["mean_last_third"]
    if reached < share * effects[0][1]:
        raise SimulationError(f"{effects[0][0]} reaches {reached:.2g} of {effects[0][1]:g} % here")


def _made(settings: BlenderSettings, effects: Sequence[tuple[str, str]]) -> MadeScene:
    """Simulated and filmed, with the label of the package's own generator."""
    with tempfile.TemporaryDirectory(prefix="toile-blind-") as scratch:
        folder = Path(scratch) / settings.name
        label = blender_scene(settings, folder)
        twin = np.load(folder / TWIN_FILE)
        # Everything as the maker wrote it: no crop, no cleaning.
        scene = load_native(folder, crop_margin=None, minimum_component=0.0)
    assert scene.ground_truth is not None
    assert scene.ground_truth.vertices is not None
    truth = scene.ground_truth.vertices
    bare = replace(scene, ground_truth=None, source=None, notes=())
    return MadeScene(bare, _common(label, effects), truth, torch.from_numpy(twin))


def _common(label: dict[str, Any], effects: Sequence[tuple[str, str]]) -> dict[str, Any]:
    """The label with the keys and units of the package's out-of-family generator."""
    names = [name for name, _ in effects]
    magnitude = dict(label["magnitude"])
    for key in ("mean_last_third", "max_last_third", "mean_all", "max_all"):
        magnitude[key] = 100 * magnitude[key]
    magnitude["per_frame_mean"] = [100 * value for value in magnitude["per_frame_mean"]]
    magnitude["unit"] = "% of the cloth's width"
    value = magnitude["mean_last_third"]
    magnitude["alone"] = {
        name: {"value": value if value > 0 else math.nan, "measure": "motion"} for name in names if value > 0
    }
    return {
        **label,
        "effects": names,
        "levels": [level for _, level in effects],
        "magnitude": magnitude,
        "comparable": {},
        "generator": "blender",
    }
