"""Scenes of a sealed set that MuJoCo makes, in the shape of those of our own generator."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np

from toile.errors import InputError
from toile.generation.clip_plan import DEFAULT_CLIPS, ClipPlan
from toile.generation.mujoco.clips import make_session, make_spare_clip
from toile.generation.mujoco.drawing import MujocoSettings
from toile.generation.mujoco.effects import MUJOCO_EFFECTS
from toile.generation.mujoco.engine import why_no_mujoco
from toile.generation.out_of_family.blind_set import PlannedScene
from toile.generation.out_of_family.catalogue import LEVELS
from toile.generation.out_of_family.making import SIZES, MadeScene
from toile.generation.out_of_family.sessions import SessionRequest

__all__ = [
    "can_make",
    "make_clips_with_mujoco",
    "make_spare_clip_with_mujoco",
    "make_with_mujoco",
    "why_no_mujoco",
]

_MOTIONS = ("hang", "shake", "sway")
_TARGETS = MappingProxyType(dict(zip(LEVELS, SIZES, strict=True)))


def can_make(planned: PlannedScene) -> bool:
    """Whether MuJoCo has what is planned: no effect, or those that it knows."""
    return all(name in MUJOCO_EFFECTS for name, _ in planned.effects)


def make_with_mujoco(
    planned: PlannedScene,
    *,
    n_frames: int = 80,
    fps: float = 50.0,
    targets: Mapping[str, float] = _TARGETS,
    setup: MujocoSettings | None = None,
) -> MadeScene:
    """Make a planned scene with MuJoCo: one clip whose corners stay, are shaken, or swing.

    Args:
        planned: see PlannedScene.
        n_frames: F.
        fps: frames per second.
        targets: mean displacement in the last third [% of the width] by level.
        setup: see MujocoSettings.

    Raises:
        InputError: MuJoCo is missing, or has no such effect, or there is no such level.
        SimulationError: no scene after several draws.
    """
    for _, level in planned.effects:
        if level not in targets:
            raise InputError("No such level", where="effects", expected=", ".join(targets), got=level)
    motion = _MOTIONS[int(np.random.default_rng([planned.seed, 0]).integers(len(_MOTIONS)))]
    effects = [(name, targets[level]) for name, level in planned.effects]
    clips = (ClipPlan(motion, n_frames, fps),)
    made = make_clips_with_mujoco(planned.name, effects, planned.seed, clips, setup=setup)[0]
    made.label["levels"] = [level for _, level in planned.effects]
    return made


def make_clips_with_mujoco(
    name: str,
    effects: Sequence[tuple[str, float]],
    seed: int,
    clips: Sequence[ClipPlan] = DEFAULT_CLIPS,
    *,
    setup: MujocoSettings | None = None,
) -> list[MadeScene]:
    """Several clips of one cloth; see mujoco.clips.make_session.

    Args:
        name: of the scenes.
        effects: (name, size) pairs, the size in % of the width against the clip without the effect, in the
            last third of the first clip; of an effect that does not move the cloth it picks the amount, see
            making.size_of.
        seed: of everything random.
        clips: in order.
        setup: see MujocoSettings.

    Raises:
        InputError: MuJoCo is missing, or the request is wrong.
        SimulationError: no scene after several draws.
    """
    return make_session(setup or MujocoSettings(), SessionRequest(name, tuple(effects), seed, tuple(clips)))


def make_spare_clip_with_mujoco(
    name: str,
    effects: Sequence[tuple[str, float]],
    seed: int,
    clips: Sequence[ClipPlan],
    plan: ClipPlan,
    attempt: int,
    strengths: Sequence[float],
    *,
    setup: MujocoSettings | None = None,
) -> MadeScene:
    """One more clip of a cloth whose clips have been made.

    Args:
        name: as make_clips_with_mujoco was told; so effects, seed, clips and setup.
        effects: see name.
        seed: see name.
        clips: see name.
        plan: of the clip; its motion and place must not be those of a clip that there is.
        attempt: as the labels of the clips say.
        strengths: as the labels of the clips say, in the order of the effects.
        setup: see name.

    Raises:
        InputError: MuJoCo is missing, or the request is wrong.
        SimulationError: no clip after several draws.
    """
    request = SessionRequest(name, tuple(effects), seed, tuple(clips))
    return make_spare_clip(setup or MujocoSettings(), request, plan, attempt, strengths)
