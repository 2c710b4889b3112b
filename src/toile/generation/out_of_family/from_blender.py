"""Scenes of a blind set that Blender makes, in the shape of those of our own generator."""

from __future__ import annotations

import math
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from toile.errors import InputError
from toile.generation.blender import process
from toile.generation.blender.effects import effect_named
from toile.generation.blender.scene import TWIN_FILE, blender_scene, matched
from toile.generation.blender.settings import random_settings
from toile.generation.out_of_family.blind_set import PlannedScene
from toile.generation.out_of_family.catalogue import LEVELS, out_of_family_effect
from toile.generation.out_of_family.interface import Measure
from toile.generation.out_of_family.making import MadeScene
from toile.scenes.native import load_native

_ATTEMPTS = 6


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
            with tempfile.TemporaryDirectory(prefix="toile-blind-") as scratch:
                folder = Path(scratch) / planned.name
                label = blender_scene(settings, folder)
                twin = np.load(folder / TWIN_FILE)
                # Everything as the maker wrote it: no crop, no cleaning.
                scene = load_native(folder, crop_margin=None, minimum_component=0.0)
        except process.BlenderError:
            raise
        except (InputError, ArithmeticError, RuntimeError) as error:
            last = error
            continue
        assert scene.ground_truth is not None
        assert scene.ground_truth.vertices is not None
        truth = scene.ground_truth.vertices
        bare = replace(scene, ground_truth=None, source=None, notes=())
        return MadeScene(bare, _common(label, planned), truth, torch.from_numpy(twin))
    raise InputError("Blender makes no such scene", where=planned.name, expected="a scene", got=str(last))


def _common(label: dict[str, Any], planned: PlannedScene) -> dict[str, Any]:
    """The label with the keys and units of the package's out-of-family generator."""
    names = [name for name, _ in planned.effects]
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
        "levels": [level for _, level in planned.effects],
        "magnitude": magnitude,
        "comparable": {},
        "generator": "blender",
    }
