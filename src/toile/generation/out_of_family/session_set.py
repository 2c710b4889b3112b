"""What a blind set of sessions is made of, and sessions written so that their files tell nothing."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from toile.effects.base import Stage
from toile.effects.catalogue import STAGES
from toile.generation.clip_plan import DEFAULT_CLIPS, ClipPlan
from toile.generation.out_of_family.blind_set import WRITTEN_AT, write_opaque
from toile.generation.out_of_family.catalogue import INSIDE, OUTSIDE
from toile.generation.out_of_family.making import SIZES
from toile.scenes.atomic_folder import folder_written_atomically
from toile.scenes.scene import Scene
from toile.scenes.session import Session, SessionClip, write_session

Sized = tuple[tuple[str, float], ...]
"""Effects with their sizes, see ``making.size_of``."""

CHANGED = {"turned": ("grip",), "fan_off": ("fan",)}
"""What is said to have been changed for a motion."""

_OPTICAL = tuple(n for n in INSIDE if STAGES[n] in (Stage.CAMERA, Stage.APPEARANCE, Stage.OBSERVATION))
MOVING = tuple(n for n in INSIDE if n not in _OPTICAL)
"""Effects of the catalogue that move the cloth."""
_SMALL, _MEDIUM, _LARGE = SIZES


@dataclass(frozen=True)
class SessionComposition:
    """How many sessions of which kind.

    Attributes:
        nulls: sessions without any effect.
        singles: (effect, size) pairs of the catalogue.
        pairs: sessions of two effects that move the cloth, of different stages or one optical; drawn.
        pairs_of_a_stage: sessions of two mechanical effects; drawn.
        outside: (effect, size) pairs from outside the catalogue.
        generators: that share the sessions evenly.
    """

    nulls: int
    singles: Sized
    pairs: int
    pairs_of_a_stage: int
    outside: Sized
    generators: tuple[str, ...] = ("toile",)

    @property
    def size(self) -> int:
        """Number of sessions."""
        drawn = self.pairs + self.pairs_of_a_stage
        return self.nulls + len(self.singles) + drawn + len(self.outside)


def sessions_composition() -> SessionComposition:
    """Sixty sessions: 20 nulls, 29 singles, 5 pairs (2 of them within a stage), 6 from outside."""
    singles = [(name, _MEDIUM) for name in MOVING]
    singles += [(name, _LARGE if k % 2 == 0 else _SMALL) for k, name in enumerate(MOVING)]
    sizes = (_MEDIUM, _LARGE, _SMALL)
    singles += [(name, sizes[k % 3]) for k, name in enumerate(_OPTICAL)]
    outside = [(name, _LARGE) for name in OUTSIDE] + [(OUTSIDE[0], _MEDIUM)]
    return SessionComposition(20, tuple(singles), 3, 2, tuple(outside), ("toile", "blender", "mujoco"))


def outside_sessions_composition() -> SessionComposition:
    """Twelve sessions that ask what is made of causes that the catalogue lacks.

    Four that move the cloth by 7 %, the four of the catalogue that are nearest to them, of 3 %, and four
    nulls.
    """
    moving = [name for name in OUTSIDE if name != "unmasked_occluder"]
    near = ("gusts", "rest_curvature", "air_drag", "nonuniform_density")
    singles = tuple((name, _MEDIUM) for name in near)
    outside = tuple((name, _LARGE) for name in moving)
    return SessionComposition(4, singles, 0, 0, outside, ("toile", "blender", "mujoco"))


def medium_sessions_composition() -> SessionComposition:
    """Every effect that moves the cloth once, of 3 %, a null for every three, and the causes from outside.

    Asked of part of a set (``first``) it tells more of the rates that are aimed at than the sixty, which
    have three sizes.
    """
    singles = tuple((name, _MEDIUM) for name in MOVING)
    outside = tuple((name, _LARGE) for name in OUTSIDE)
    return SessionComposition(len(singles) // 3, singles, 0, 0, outside, ("toile", "blender", "mujoco"))


def effects_sessions_composition() -> SessionComposition:
    """Every effect that moves the cloth once, of 3 %, and nothing else: for the rate of naming them."""
    singles = tuple((name, _MEDIUM) for name in MOVING)
    return SessionComposition(0, singles, 0, 0, (), ("toile", "blender", "mujoco"))


def tiny_sessions_composition() -> SessionComposition:
    """Three sessions: none, one of the catalogue, one from outside."""
    return SessionComposition(1, (("gusts", _LARGE),), 0, 0, (("vortex_field", _LARGE),))


@dataclass(frozen=True)
class PlannedSession:
    """One session of a set.

    Attributes:
        name: opaque.
        effects: with their sizes.
        seed: of everything random in it.
        generator: "toile", "blender" or "mujoco".
        clips: what is done in them.
    """

    name: str
    effects: Sized
    seed: int
    generator: str = "toile"
    clips: tuple[ClipPlan, ...] = DEFAULT_CLIPS


def plan_sessions(
    composition: SessionComposition,
    secret: Callable[[str], bytes],
    clips: tuple[ClipPlan, ...] = DEFAULT_CLIPS,
    can_make: Callable[[str, Sized], bool] = lambda generator, effects: True,
) -> tuple[PlannedSession, ...]:
    """The sessions of a set in the order of their names, which is unrelated to what they hold.

    Args:
        composition: see SessionComposition.
        secret: 32 bytes by purpose, from the set's key; everything random follows from it.
        clips: of every session.
        can_make: whether a generator has some effects; what it has not goes to the next one that has. It must
            not depend on what is installed, or the plan would.
    """
    rng = np.random.default_rng(_number(secret("pairs")))
    kinds: list[Sized] = [()] * composition.nulls
    kinds += [((name, size),) for name, size in composition.singles]
    kinds += [_pair(rng, of_a_stage=False) for _ in range(composition.pairs)]
    kinds += [_pair(rng, of_a_stage=True) for _ in range(composition.pairs_of_a_stage)]
    kinds += [((name, size),) for name, size in composition.outside]
    # Nulls and others are shared evenly each, in an order that is drawn.
    makers = [""] * len(kinds)
    for members in (range(composition.nulls), range(composition.nulls, len(kinds))):
        for k, index in enumerate(rng.permutation(list(members))):
            makers[index] = _maker(composition.generators, k, kinds[index], can_make)
    names = [secret(f"name {k}").hex() for k in range(len(kinds))]
    length = next(n for n in range(6, 65) if len({name[:n] for name in names}) == len(names))
    sessions = [
        PlannedSession(names[k][:length], effects, _number(secret(f"seed {k}")), makers[k], clips)
        for k, effects in enumerate(kinds)
    ]
    return tuple(sorted(sessions, key=lambda session: session.name))


def write_opaque_session(name: str, clips: Sequence[tuple[ClipPlan, Scene]], folder: Path) -> Path:
    """Write a session without any truth: the same files whatever it holds.

    Args:
        name: of the session.
        clips: with what was done in them; everybody may know that.
        folder: must not exist.

    Raises:
        InputError: the folder exists, or a scene comes with its truth.
    """
    with folder_written_atomically(folder, overwrite=False) as new:
        new.mkdir()
        members = []
        for k, (plan, scene) in enumerate(clips):
            path = write_opaque(scene, new / f"clip_{k}")
            members.append(SessionClip(path, plan.motion, changed=CHANGED.get(plan.motion, ())))
        file = write_session(Session(name, tuple(members)), new)
        for path in (file, new):
            os.utime(path, (WRITTEN_AT, WRITTEN_AT))
    return folder


def _maker(
    generators: tuple[str, ...], turn: int, effects: Sized, can_make: Callable[[str, Sized], bool]
) -> str:
    """The generator whose turn it is, or the next one that has these effects; our own has all."""
    order = [generators[(turn + k) % len(generators)] for k in range(len(generators))]
    return next((g for g in order if g == "toile" or can_make(g, effects)), "toile")


def _pair(rng: np.random.Generator, *, of_a_stage: bool) -> Sized:
    """Two mechanical effects, or one that moves the cloth with one of another stage; medium or large."""
    mechanical = [n for n in MOVING if STAGES[n] is Stage.MECHANICS]
    firsts = mechanical if of_a_stage else list(MOVING)
    first = firsts[int(rng.integers(len(firsts)))]
    others = [
        n
        for n in (mechanical if of_a_stage else INSIDE)
        if n != first and (of_a_stage or STAGES[n] is not STAGES[first])
    ]
    second = others[int(rng.integers(len(others)))]
    sizes = [SIZES[1 + int(rng.integers(2))] for _ in range(2)]
    return (first, sizes[0]), (second, sizes[1])


def _number(secret: bytes) -> int:
    return int.from_bytes(secret[:7], "big")
