"""Sessions in a blind check: planned, made by the engines that are there, cut to one clip, and extended."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
import yaml
from omegaconf import DictConfig

from toile.atomic_file import write_text
from toile.blind.answers import read_answer
from toile.blind.run import Predictions
from toile.blind.sealing import BlindSet, Sealed, SealKey
from toile.errors import InputError
from toile.generation.clip_plan import MOTIONS, ClipPlan
from toile.generation.mujoco.effects import MUJOCO_EFFECTS
from toile.generation.out_of_family.base_scene import OutOfFamilySettings
from toile.generation.out_of_family.blind_set import write_opaque
from toile.generation.out_of_family.from_blender import (
    can_make_clips,
    make_clips_with_blender,
    make_spare_clip_with_blender,
    why_no_blender,
)
from toile.generation.out_of_family.from_mujoco import (
    make_clips_with_mujoco,
    make_spare_clip_with_mujoco,
    why_no_mujoco,
)
from toile.generation.out_of_family.making import MadeScene
from toile.generation.out_of_family.session_set import (
    CHANGED,
    PlannedSession,
    SessionComposition,
    Sized,
    effects_sessions_composition,
    medium_sessions_composition,
    outside_sessions_composition,
    plan_sessions,
    sessions_composition,
    tiny_sessions_composition,
    write_opaque_session,
)
from toile.generation.out_of_family.sessions import SessionRequest, make_session, make_spare_clip
from toile.physics.simulator import SimulationError
from toile.scenes.atomic_folder import folder_written_atomically
from toile.scenes.session import SESSION_FILE, Session, SessionClip, load_session

COMPOSITIONS: dict[str, Callable[[], SessionComposition]] = {
    "sessions": sessions_composition,
    "sessions_effects": effects_sessions_composition,
    "sessions_medium": medium_sessions_composition,
    "sessions_outside": outside_sessions_composition,
    "sessions_tiny": tiny_sessions_composition,
}
EXTENDED = "extended"
"""Part of a set: sessions with one clip more."""
NEXT_CLIP = "clip_next"
"""Folder of that clip."""
_OTHER_ENGINES = {"blender": "Blender", "mujoco": "MuJoCo"}
GENERATORS = ("toile", *_OTHER_ENGINES)
"""Who can make sessions."""


def planned_sessions(cfg: DictConfig, key: SealKey) -> tuple[tuple[PlannedSession, ...], list[str]]:
    """The sessions of a set, each by an engine that is there, and notes on those that are not."""
    composition = COMPOSITIONS[str(cfg.composition)]()
    if cfg.generators is not None:
        composition = replace(composition, generators=_generators(cfg.generators))
    sessions = plan_sessions(composition, key.derive, clips_of(cfg), _can_make)
    notes = []
    unable = sum(s.generator not in composition.generators for s in sessions)
    if unable:
        notes.append(
            f"{unable} sessions come from the package's out-of-family generator: no other one that was asked "
            "for has their effects"
        )
    absent = {}
    for engine, title in _OTHER_ENGINES.items():
        planned = sum(s.generator == engine for s in sessions)
        reason = why_not(engine, wanted=bool(cfg[engine])) if planned else ""
        if reason:
            absent[engine] = reason
            notes.append(
                f"{planned} sessions meant for {title} come from the package's out-of-family generator: "
                f"{reason}"
            )
    return tuple(replace(s, generator="toile") if s.generator in absent else s for s in sessions), notes


def _generators(names: Sequence[str]) -> tuple[str, ...]:
    """Generators that share a set, by name."""
    if not names or not set(names) <= set(GENERATORS):
        raise InputError(
            "No such generators", where="generators", expected=", ".join(GENERATORS), got=str(list(names))
        )
    return tuple(names)


def clips_of(cfg: DictConfig) -> tuple[ClipPlan, ...]:
    """What is done in the clips of every session; a motion that comes twice has two places."""
    motions = [str(motion) for motion in cfg.clips]
    if not motions:
        raise InputError("A session needs a clip", where="clips", expected="one or more", got="none")
    n_frames, fps = int(cfg.out_of_family.n_frames), float(cfg.out_of_family.fps)
    return tuple(ClipPlan(m, n_frames, fps, motions[:k].count(m)) for k, m in enumerate(motions))


def why_not(engine: str, *, wanted: bool) -> str:
    """Why an engine cannot make sessions here; "" where it can."""
    if not wanted:
        return f"it was not wanted ({engine}=false)"
    return why_no_mujoco() if engine == "mujoco" else why_no_blender()


def make_one_session(
    planned: PlannedSession, setup: OutOfFamilySettings, blind: BlindSet, key: SealKey
) -> str:
    """Make one session and seal its label; nothing happens if both are there. Returns its name."""
    if blind.is_made(planned.name):
        return planned.name
    if planned.generator == "toile":
        request = SessionRequest(planned.name, planned.effects, planned.seed, planned.clips)
        clips = make_session(setup, request)
    elif planned.generator == "blender":
        small = min(setup.grid) < 16
        clips = make_clips_with_blender(
            planned.name, planned.effects, planned.seed, planned.clips, small=small
        )
    else:
        clips = make_clips_with_mujoco(planned.name, planned.effects, planned.seed, planned.clips)
    # The label first: a session without label would be made again under other random numbers.
    blind.seal(key, planned.name, sealed_session(clips))
    if not blind.is_there(planned.name):
        films = [(plan, made.scene) for plan, made in zip(planned.clips, clips, strict=True)]
        write_opaque_session(planned.name, films, blind.scenes / planned.name)
    return planned.name


def sealed_session(clips: Sequence[MadeScene]) -> Sealed:
    """Label of the first clip with those of all under ``clips``; motions one after the other in time."""
    label = {**clips[0].label, "clips": [made.label for made in clips]}
    vertices = torch.cat([made.vertices for made in clips]).float().numpy()
    twin = torch.cat([made.twin for made in clips]).float().numpy()
    return Sealed({**label, "n_frames": [made.scene.n_frames for made in clips]}, vertices, twin)


class FirstClipAlone:
    """A diagnosis of sessions that sees their first clip only.

    Args:
        diagnose: of sessions.
    """

    def __init__(self, diagnose: Callable[[Path, Path, Any], None]) -> None:
        self._diagnose = diagnose

    def __call__(self, session_folder: Path, output_folder: Path, settings: Any) -> None:
        """Diagnose; see blind.run.Diagnose."""
        session = load_session(session_folder)
        folder = output_folder / "first_clip"
        folder.mkdir(parents=True, exist_ok=True)
        _write_pointing(replace(session, clips=session.clips[:1]), folder)
        self._diagnose(folder, output_folder, settings)


def diagnose_first_clip(session_folder: Path, output_folder: Path, settings: Any) -> None:
    """Diagnose the first clip of a session as a scene of its own: the method of single clips."""
    from toile.cli.diagnose import diagnose_scene

    diagnose_scene(load_session(session_folder).clips[0].folder, output_folder, settings)


def extend_sessions(
    cfg: DictConfig, setup: OutOfFamilySettings, blind: BlindSet, key: SealKey, predictions: Predictions
) -> tuple[int, list[str]]:
    """Make the clip that each diagnosis asks for, and sessions with it in ``extended/``.

    Whoever does this has the key, and nothing of the label gets into what is written.

    Returns:
        How many sessions have been extended, and notes on those that have not.
    """
    extended = replace(blind, part=EXTENDED)
    sessions, _ = planned_sessions(cfg, key)
    made, notes = 0, []
    for session in sessions:
        if session.name not in blind.names() or not predictions.diagnosis(session.name).is_file():
            continue
        # The engine that has made the cloth, whatever is wanted or installed by now.
        engine = str(blind.open(key, session.name).label["generator"])
        planned = replace(session, generator=engine)
        reason = why_not(engine, wanted=True) if engine in _OTHER_ENGINES else ""
        if reason:
            notes.append(f"{planned.name}: {reason}")
            continue
        answer = read_answer(predictions.diagnosis(planned.name))
        # An engine that cannot do what tells most does what tells most of the rest.
        can = [m for m in answer.next_motions if m in MOTIONS and _can_do(planned.generator, m)]
        asked = answer.next_motion
        if not extended.is_there(planned.name):
            if not can:
                notes.append(
                    f"{planned.name}: {f'no motion {asked!r}' if asked else 'no recording asked for'}"
                )
                continue
            failure = _extend_by_one_of(planned, can, setup, blind, extended, key)
            if failure:
                notes.append(f"{planned.name}: {failure}")
                continue
        made += 1
    return made, notes


def _extend_by_one_of(
    planned: PlannedSession,
    motions: Sequence[str],
    setup: OutOfFamilySettings,
    blind: BlindSet,
    extended: BlindSet,
    key: SealKey,
) -> str:
    """Make the first of these motions that can be made; returns why none can, or ""."""
    failure = ""
    for motion in motions:
        try:
            _extend(planned, motion, setup, blind, extended, key)
        except SimulationError as error:
            failure = f"{motion}: {error}"
        else:
            return ""
    return failure


def _extend(
    planned: PlannedSession,
    motion: str,
    setup: OutOfFamilySettings,
    blind: BlindSet,
    extended: BlindSet,
    key: SealKey,
) -> None:
    first = planned.clips[0]
    place = sum(clip.motion == motion for clip in planned.clips)
    plan = ClipPlan(motion, first.n_frames, first.fps, place)
    said = blind.open(key, planned.name).label["session"]
    request = SessionRequest(planned.name, planned.effects, planned.seed, planned.clips)
    strengths = [said["strengths"][name] for name, _ in planned.effects]
    attempt = int(said["attempt"])
    if planned.generator == "mujoco":
        spare = make_spare_clip_with_mujoco(
            planned.name, planned.effects, planned.seed, planned.clips, plan, attempt, strengths
        )
    elif planned.generator == "blender":
        small = min(setup.grid) < 16
        spare = make_spare_clip_with_blender(
            planned.name,
            planned.effects,
            planned.seed,
            plan,
            attempt,
            said["strengths"],
            steps=said.get("steps"),
            small=small,
        )
    else:
        spare = make_spare_clip(setup, request, plan, attempt, strengths)
    before = load_session(blind.scenes / planned.name)
    folder = extended.scenes / planned.name
    clip = SessionClip(folder / NEXT_CLIP, motion, changed=CHANGED.get(motion, ()))
    with folder_written_atomically(folder, overwrite=False) as new:
        new.mkdir()
        write_opaque(spare.scene, new / NEXT_CLIP)
        _write_pointing(replace(before, clips=(*before.clips, clip)), new)


def _write_pointing(session: Session, folder: Path) -> Path:
    """Write ``session.yaml`` with the full paths of clips that lie elsewhere."""
    clips = [
        {
            "scene": str(clip.folder.resolve()),
            "motion": clip.motion,
            "device": clip.device,
            "changed": list(clip.changed),
        }
        for clip in session.clips
    ]
    values = {
        "name": session.name,
        "clips": clips,
        "plumb_line": session.plumb_line,
        "clock": session.clock,
    }
    return write_text(folder / SESSION_FILE, yaml.safe_dump(values, sort_keys=False))


def _can_do(engine: str, motion: str) -> bool:
    """Whether an engine can do a motion: Blender's cloth hangs from one pair of corners."""
    return engine != "blender" or motion != "turned"


def _can_make(engine: str, effects: Sized) -> bool:
    """Whether an engine has some effects, installed or not: the plan of a set depends on nothing else."""
    if engine == "mujoco":
        return all(name in MUJOCO_EFFECTS for name, _ in effects)
    return can_make_clips(effects)
