"""What a blind set is made of, and scenes written so that their files tell nothing."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from toile.errors import InputError
from toile.generation.out_of_family.catalogue import INSIDE, LEVELS, OUTSIDE
from toile.scenes.native import write_native
from toile.scenes.scene import Scene

Effects = tuple[tuple[str, str], ...]

WRITTEN_AT = 946684800
"""Time stamp of all files of a scene [s since 1970]: when, and in what time, it was made would tell."""


@dataclass(frozen=True)
class Composition:
    """How many scenes of which kind.

    Attributes:
        nulls: scenes without any effect.
        singles: (effect, level) pairs of the catalogue; "" as effect or level for one drawn at random.
        pairs: scenes with two effects of different stages, or of different kinds, drawn at random.
        outside: (effect, level) pairs from outside the catalogue.
        blender_share: share of the nulls and singles that Blender makes where it is installed.
    """

    nulls: int
    singles: tuple[tuple[str, str], ...]
    pairs: int
    outside: tuple[tuple[str, str], ...]
    blender_share: float = 0.0

    @property
    def size(self) -> int:
        """Number of scenes."""
        return self.nulls + len(self.singles) + self.pairs + len(self.outside)


def tiny_composition() -> Composition:
    """Three scenes: none, one of the catalogue, one from outside."""
    return Composition(1, (("gusts", "strong"),), 0, (("vortex_field", "strong"),))


def standard_composition() -> Composition:
    """Sixty scenes: 10 nulls, 36 singles, 6 pairs, 8 from outside."""
    singles = [(name, "medium") for name in INSIDE]
    singles += [(name, "strong" if k % 2 == 0 else "weak") for k, name in enumerate(INSIDE)]
    singles += [("air_drag", "weak"), ("gusts", "strong")]
    outside = [(name, "strong") for name in OUTSIDE] + [(name, "medium") for name in OUTSIDE[:3]]
    return Composition(10, tuple(singles), 6, tuple(outside), blender_share=1 / 3)


def full_composition() -> Composition:
    """430 scenes: 70 nulls, 17 effects × 3 levels × 5, 45 pairs, 5 effects from outside × 3 levels × 4."""
    singles = tuple((name, level) for name in INSIDE for level in LEVELS for _ in range(5))
    outside = tuple((name, level) for name in OUTSIDE for level in LEVELS for _ in range(4))
    return Composition(70, singles, 45, outside, blender_share=1 / 3)


@dataclass(frozen=True)
class PlannedScene:
    """One scene of a set.

    Attributes:
        name: opaque.
        effects: (name, level) pairs.
        seed: of everything random in it.
        generator: "toile" or "blender".
    """

    name: str
    effects: Effects
    seed: int
    generator: str = "toile"


def plan(composition: Composition, secret: Callable[[str], bytes]) -> tuple[PlannedScene, ...]:
    """The scenes of a set in the order of their names, which is unrelated to what they hold.

    Args:
        composition: see Composition.
        secret: 32 bytes by purpose, from the set's key; everything random follows from it, so that whoever
            has not the key cannot make the plan again.
    """
    rng = np.random.default_rng(_number(secret("pairs")))
    kinds: list[Effects] = [()] * composition.nulls
    kinds += [((name, level),) for name, level in composition.singles]
    inside = len(kinds)
    kinds += [_pair(rng) for _ in range(composition.pairs)]
    kinds += [((name, level),) for name, level in composition.outside]
    blender = np.zeros(len(kinds), bool)
    if composition.blender_share > 0:
        chosen = rng.permutation(inside)[: round(composition.blender_share * len(kinds))]
        blender[chosen] = True
    scenes = [
        PlannedScene(
            name=secret(f"name {k}").hex()[:6],
            effects=effects,
            seed=_number(secret(f"seed {k}")),
            generator="blender" if blender[k] else "toile",
        )
        for k, effects in enumerate(kinds)
    ]
    if len({scene.name for scene in scenes}) < len(scenes):
        # Once in some hundred sets of 430.
        scenes = [replace(s, name=secret(f"name {k}").hex()[:10]) for k, s in enumerate(scenes)]
    return tuple(sorted(scenes, key=lambda scene: scene.name))


def _pair(rng: np.random.Generator) -> Effects:
    """A motion effect and an optical one in two of three cases, else two that move the cloth."""
    optical = ("focal_error", "lens_distortion", "shading", "motion_blur", "mask_bias")
    moving = [name for name in INSIDE if name not in optical]
    first = moving[int(rng.integers(len(moving)))]
    others = list(optical) if rng.random() < 2 / 3 else [name for name in moving if name != first]
    second = others[int(rng.integers(len(others)))]
    levels = [LEVELS[1 + int(rng.integers(2))] for _ in range(2)]
    return ((first, levels[0]), (second, levels[1]))


def write_opaque(scene: Scene, folder: Path) -> Path:
    """Write a scene without any truth: same files, same order, same time stamps whatever it holds.

    Raises:
        InputError: the folder exists.
    """
    if scene.ground_truth is not None:
        raise InputError(
            "A blind scene must not come with its truth", where=str(folder), expected="none", got="vertices"
        )
    write_native(scene, folder)
    for path in sorted(folder.rglob("*"), reverse=True):
        os.utime(path, (WRITTEN_AT, WRITTEN_AT))
    os.utime(folder, (WRITTEN_AT, WRITTEN_AT))
    return folder


def _number(secret: bytes) -> int:
    return int.from_bytes(secret[:7], "big")
