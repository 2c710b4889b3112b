"""``toile blind make | run | extend | grade | train``: a diagnosis checked on labels it cannot read."""

from __future__ import annotations

import importlib
import json
import logging
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from toile import __version__
from toile.atomic_file import write_text
from toile.blind.grading import grade_set, write_grade
from toile.blind.run import (
    Diagnose,
    Predictions,
    check_not_graded,
    read_predictions,
    run_blind,
    write_predictions,
)
from toile.blind.sealing import BlindSet, Sealed, SealKey
from toile.blind.session_grading import grade_sessions, write_session_grade
from toile.cli.blind_sessions import (
    COMPOSITIONS as SESSIONS,
)
from toile.cli.blind_sessions import (
    EXTENDED,
    FirstClipAlone,
    clips_of,
    diagnose_first_clip,
    extend_sessions,
    make_one_session,
    planned_sessions,
)
from toile.cli.blind_train import train
from toile.cli.configuration import instantiate
from toile.cli.failures import CommandError
from toile.cli.terminal import print_path
from toile.errors import InputError
from toile.generation.out_of_family.base_scene import OutOfFamilySettings
from toile.generation.out_of_family.blind_set import (
    Composition,
    PlannedScene,
    full_composition,
    plan,
    standard_composition,
    tiny_composition,
    write_opaque,
)
from toile.generation.out_of_family.from_blender import can_make, make_with_blender, why_no_blender
from toile.generation.out_of_family.making import SceneRequest, make_scene
from toile.generation.out_of_family.session_set import PlannedSession
from toile.json_file import read_json_object
from toile.scenes.registry import available_scenes

_COMPOSITIONS: dict[str, Callable[[], Composition]] = {
    "tiny": tiny_composition,
    "standard": standard_composition,
    "full": full_composition,
}

_KINDS = ("one_clip", "as_scene", "extended")
"""Answers to sessions that are not from all of their clips; settings of toile blind run."""

_COPIED = "copied.txt"
"""Beside an answer that is that without another clip."""
_HOW = "how.json"
"""In a folder of predictions: by what they were made."""

_log = logging.getLogger(__name__)


def run(cfg: DictConfig) -> None:
    """Carry out one of the actions, each in a process of its own."""
    actions = {"make": _make, "run": _run, "extend": _extend, "grade": _grade}
    action = str(cfg.action)
    if action == "train":
        train(cfg.learned)
        return
    if action not in actions:
        raise InputError(
            "No such action", where="toile blind", expected=", ".join((*actions, "train")), got=action
        )
    blind = BlindSet(Path(cfg.folder))
    key = Path(cfg.key).resolve()
    if key.is_relative_to(blind.folder.resolve().parent):
        raise InputError(
            "The key would lie within reach of the diagnosis",
            where="key",
            expected=f"a file outside {blind.folder.parent}",
            got=str(cfg.key),
        )
    if cfg.first is not None and action != "make" and int(cfg.first) != len(blind.names()):
        raise InputError(
            "The set has another number of scenes",
            where="first",
            expected=f"{len(blind.names())}, or toile blind make with the same first=",
            got=str(cfg.first),
        )
    if blind.description.is_file():
        _check_asked(cfg, blind, action)
    actions[action](cfg, blind)


def make_one(
    planned: PlannedScene, setup: OutOfFamilySettings, blind: BlindSet, key: SealKey, *, small: bool
) -> str:
    """Make one scene and seal its label; nothing happens if both are there. Returns its name."""
    if blind.is_made(planned.name):
        return planned.name
    if planned.generator == "blender":
        made = make_with_blender(planned, small=small)
    else:
        made = make_scene(setup, SceneRequest(planned.name, planned.effects, planned.seed))
    sealed = Sealed(made.label, made.vertices.float().numpy(), made.twin.float().numpy())
    # The label first: a scene without label would be made again under other random numbers of its nonce.
    blind.seal(key, planned.name, sealed)
    if not (blind.scenes / planned.name).exists():
        write_opaque(made.scene, blind.scenes / planned.name)
    return planned.name


def _make(cfg: DictConfig, blind: BlindSet) -> None:
    key = _key_of(cfg, blind)
    setup, notes = _out_of_family(cfg)
    scenes, more = _planned(cfg, key)
    notes += more
    if cfg.first is not None:
        notes.append(f"the first {cfg.first} of {len(scenes)} scenes in the order of their names")
        scenes = scenes[: int(cfg.first)]
    names = tuple(scene.name for scene in scenes)
    if not Path(cfg.key).is_file():
        # What is refused leaves no key behind.
        key.write(Path(cfg.key))
    _describe(cfg, blind, key, names, notes)
    small = min(setup.grid) < 16
    todo = [s for s in _part(cfg, scenes) if not blind.is_made(s.name)]
    with _progress("make", len(todo)) as advance:
        tasks = [
            partial(make_one_session, scene, setup, blind, key)
            if isinstance(scene, PlannedSession)
            else partial(make_one, scene, setup, blind, key, small=small)
            for scene in todo
        ]
        for name in _parallel(tasks, int(cfg.jobs)):
            advance(str(name), None)
    if all(blind.is_made(name) for name in names):
        blind.commit(key, names)
        print_path(blind.folder, f": {len(names)} scenes; key: {cfg.key}")
        for note in notes:
            print_path(note)
    else:
        left = sum(not blind.is_made(name) for name in names)
        print_path(blind.folder, f": {left} of {len(names)} scenes are left to other parts")


def _planned(
    cfg: DictConfig, key: SealKey
) -> tuple[tuple[PlannedScene, ...] | tuple[PlannedSession, ...], list[str]]:
    """Scenes or sessions of the composition, and notes on engines that are not there."""
    name = str(cfg.composition)
    if name in SESSIONS:
        return planned_sessions(cfg, key)
    composition = _COMPOSITIONS.get(name)
    if composition is None:
        known = ", ".join((*_COMPOSITIONS, *SESSIONS))
        raise InputError("No such composition", where="composition", expected=known, got=cfg.composition)
    return _with_blender_where_possible(plan(composition(), key.derive), wanted=cfg.blender)


def _extend(cfg: DictConfig, blind: BlindSet) -> None:
    """Make the clips that the diagnoses of a set of sessions have asked for."""
    _check_sessions(cfg, "extend")
    predictions = _predictions(cfg)
    check_not_graded(blind, predictions)
    # Else a diagnosis could be exchanged for one that asks for another clip.
    read_predictions(blind, predictions)
    setup, _ = _out_of_family(cfg)
    made, notes = extend_sessions(cfg, setup, blind, SealKey.read(Path(cfg.key)), predictions)
    print_path(blind.folder / EXTENDED, f": {made} of {len(blind.names())} sessions with one clip more")
    for note in notes:
        print_path(note)


def _check_sessions(cfg: DictConfig, what: str) -> None:
    if str(cfg.composition) not in SESSIONS:
        raise InputError(
            "Only sessions have several clips",
            where=what,
            expected=f"set={' or set='.join(SESSIONS)}",
            got=f"composition={cfg.composition}",
        )


def _predictions(cfg: DictConfig, kind: str = "") -> Predictions:
    """Where the answers go: those of a kind, one of _KINDS, have a folder of their own."""
    return Predictions(Path(f"{cfg.predictions}{f'_{kind}' if kind else ''}"))


def _run(cfg: DictConfig, blind: BlindSet) -> None:
    asked = [kind for kind in _KINDS if cfg[kind]]
    if len(asked) > 1:
        raise InputError(
            "A run has one kind of answers",
            where=", ".join(_KINDS),
            expected="one of them",
            got=" and ".join(asked),
        )
    predictions = _predictions(cfg, *asked)
    names = tuple(sorted(blind.names()))
    part = _part(cfg, names)
    settings = instantiate(cfg.settings)
    diagnose: Diagnose = _function(str(cfg.diagnose))
    if asked:
        _check_sessions(cfg, *asked)
    _check_answers_alike(cfg, predictions)
    if cfg.one_clip:
        diagnose = FirstClipAlone(diagnose)
    if cfg.as_scene:
        diagnose = diagnose_first_clip
    if cfg.extended:
        before = _predictions(cfg)
        read_predictions(blind, before)
        blind = replace(blind, part=EXTENDED)
        for name in names:
            own = predictions.folder / name
            if not blind.is_there(name) and before.diagnosis(name).is_file():
                # Where no other clip was asked for, the answer stays.
                shutil.copytree(before.folder / name, own, dirs_exist_ok=True)
                write_text(own / _COPIED, "the answer without another clip: none had been made\n")
            elif blind.is_there(name) and (own / _COPIED).is_file():
                # The clip has been made since.
                shutil.rmtree(own)
        part = [name for name in part if blind.is_there(name)]
    if cfg.max_sessions is not None:
        part = [n for n in part if not predictions.diagnosis(n).is_file()][: int(cfg.max_sessions)]
    with _progress("run", len(part)) as advance:
        left = run_blind(
            blind,
            predictions,
            diagnose,
            settings,
            jobs=int(cfg.jobs),
            only=tuple(part),
            report=lambda name, done, total, failure: advance(name, failure),
        )
    for name in left:
        first = predictions.failure(name).read_text().strip().rpartition("\n")[2]
        print_path(f"{name}: {first}")
    if left and not cfg.incomplete:
        raise CommandError(3)
    unanswered = [n for n in names if not predictions.diagnosis(n).is_file()]
    if unanswered and not cfg.incomplete:
        print_path(predictions.folder, f": {len(unanswered)} scenes are left to other parts")
        return
    digest = write_predictions(blind, predictions, incomplete=bool(cfg.incomplete))
    print_path(predictions.list, f": sha256 {digest}")


def _check_answers_alike(cfg: DictConfig, predictions: Predictions) -> None:
    """Refuse to add answers by another method or other settings to those that are there."""
    settings = OmegaConf.to_container(cfg.settings, resolve=True) if cfg.settings is not None else None
    asked: dict[str, Any] = {"diagnose": str(cfg.diagnose), "settings": settings}
    path = predictions.folder / _HOW
    answered = any(predictions.folder.glob("*/diagnosis.json"))
    before = read_json_object(path) if answered and path.is_file() else {}
    _refuse_others(before, asked, "The answers there were", f"{path}, or another predictions=...")
    if not before:
        write_text(path, json.dumps(asked, indent=1) + "\n")


def _grade(cfg: DictConfig, blind: BlindSet) -> None:
    if str(cfg.composition) in SESSIONS:
        _grade_sessions(cfg, blind)
        return
    if cfg.table is not None:
        _check_sessions(cfg, "table")
    predictions = Predictions(Path(cfg.predictions))
    key = SealKey.read(Path(cfg.key))
    grade = grade_set(blind, predictions, key, alias=float(cfg.alias), resamplings=int(cfg.bootstrap), seed=0)
    for path in write_grade(grade, predictions.grade):
        print_path(path)


def _grade_sessions(cfg: DictConfig, blind: BlindSet) -> None:
    """Mark what there is of: all clips, the first one alone or as a scene, and all with the one asked for."""
    clips = len(clips_of(cfg))
    # Sessions of one clip have no other answers from the first alone.
    kinds = {
        str(clips): _predictions(cfg),
        **({"1": _predictions(cfg, "one_clip")} if clips > 1 else {}),
        "1, as a scene": _predictions(cfg, "as_scene"),
        f"{clips}+1": _predictions(cfg, "extended"),
    }
    there = {title: p for title, p in kinds.items() if p.list.is_file()} or {str(clips): kinds[str(clips)]}
    grade = grade_sessions(blind, there, SealKey.read(Path(cfg.key)), resamplings=int(cfg.bootstrap), seed=0)
    table = None if cfg.table is None else Path(cfg.table)
    for path in write_session_grade(grade, kinds[str(clips)].grade, table):
        print_path(path)


def _key_of(cfg: DictConfig, blind: BlindSet) -> SealKey:
    """The set's key: the one there is, else a fresh one or that of the seed, which is not written yet."""
    path = Path(cfg.key)
    key = SealKey.read(path) if path.is_file() else None
    if key is None:
        if blind.description.is_file():
            raise InputError(
                "The set exists, but its key does not",
                where=str(path),
                expected="the key that the set was begun with, or another folder=...",
                got="no file",
            )
        key = SealKey.fresh() if cfg.seed is None else SealKey.of_seed(int(cfg.seed))
    elif cfg.seed is not None and key.fingerprint != SealKey.of_seed(int(cfg.seed)).fingerprint:
        raise InputError(
            "The key that lies there is not that of the seed",
            where=str(path),
            expected=f"the key of seed={int(cfg.seed)}, no file, or another name=...",
            got="another key",
        )
    elif not blind.description.is_file():
        # As where several machines share a set; or its labels are open, or anybody knows the seed.
        _log.warning(
            "%s: a key lies there and is used; a set that was made with it before has the same scenes", path
        )
    if blind.description.is_file() and blind.read_description()["key"] != key.fingerprint:
        raise InputError(
            "The key is not the set's", where=str(path), expected="the set's key", got="another key"
        )
    return key


def _out_of_family(cfg: DictConfig) -> tuple[OutOfFamilySettings, list[str]]:
    """The generator's settings with the templates that are there, and notes on those that are not."""
    setup: OutOfFamilySettings = instantiate(cfg.out_of_family)(data=str(cfg.paths.data))
    known = set(available_scenes(cfg.paths.data)) if setup.templates else set()
    there = tuple(name for name in setup.templates if name in known)
    notes = []
    if len(there) < len(setup.templates):
        absent = ", ".join(sorted(set(setup.templates) - set(there)))
        notes.append(f"templates that are not in the data folder were left out: {absent}")
    return replace(setup, templates=there), notes


def _with_blender_where_possible(
    scenes: tuple[PlannedScene, ...], *, wanted: bool
) -> tuple[tuple[PlannedScene, ...], list[str]]:
    """Scenes with Blender's share made by our own generator where Blender is not there."""
    planned = [s for s in scenes if s.generator == "blender"]
    reason = "it was not wanted (blender=false)" if not wanted else why_no_blender() if planned else ""
    unable = {s.name for s in planned if reason or not can_make(s)}
    notes = []
    if unable:
        notes.append(
            f"{len(unable)} scenes meant for Blender come from the package's out-of-family generator: "
            + (reason or "Blender does not offer their effects")
        )
    changed = tuple(replace(s, generator="toile") if s.name in unable else s for s in scenes)
    return changed, notes


def _describe(
    cfg: DictConfig, blind: BlindSet, key: SealKey, names: tuple[str, ...], notes: list[str]
) -> None:
    """Write set.json, or check that the one there belongs to the same set."""
    # Notes on the generators are public, which scene has which label is not.
    values = {
        "name": str(cfg.name),
        "version": __version__,
        "composition": str(cfg.composition),
        "out_of_family": _plain(cfg.out_of_family),
        **_asked(cfg),
        "blind": cfg.seed is None,
        "key": key.fingerprint,
        "notes": notes,
        "scenes": list(names),
    }
    if blind.description.is_file():
        before = blind.read_description()
        common = min(len(before["scenes"]), len(names))
        others = before["scenes"][:common] != list(names)[:common]
        if others or before["out_of_family"] != values["out_of_family"] or before["key"] != key.fingerprint:
            raise InputError(
                "The folder holds another set",
                where=str(blind.folder),
                expected="the same composition and settings, or another folder=...",
                got=f"{before['composition']}, {len(before['scenes'])} scenes",
            )
        if before["scenes"] == list(names):
            return
        # The same set with another first=: its scenes are in the order of their names, so they stay.
    write_text(blind.description, json.dumps(values, indent=1) + "\n")


def _asked(cfg: DictConfig) -> dict[str, Any]:
    """What sessions were asked for beside the composition; plans of sets and answers depend on it."""
    if str(cfg.composition) not in SESSIONS:
        return {}
    generators = None if cfg.generators is None else [str(name) for name in cfg.generators]
    return {"clips": [str(motion) for motion in cfg.clips], "generators": generators}


def _check_asked(cfg: DictConfig, blind: BlindSet, action: str) -> None:
    """Refuse to go on with another set: by its plan, of one clip where it has three, or by other engines.

    A set that is graded by the measures of another kind of set is spent, and one that is extended by another
    plan gets clips of other cloths: names depend on the key alone.
    """
    before = blind.read_description()
    asked = {"composition": str(cfg.composition), **_asked(cfg)}
    if action == "extend":
        mine, theirs = _plain(cfg.out_of_family), before["out_of_family"]
        asked |= {f"out_of_family.{name}": value for name, value in mine.items()}
        before |= {f"out_of_family.{name}": value for name, value in theirs.items()}
    _refuse_others(before, asked, "The set was", str(blind.description))


def _refuse_others(before: Mapping[str, Any], asked: Mapping[str, Any], what: str, kept: str) -> None:
    """Raise InputError where a setting is another one; what was made before it was kept says nothing."""
    for name, got in asked.items():
        if name in before and before[name] != got:
            raise InputError(
                f"{what} made with another setting",
                where=name,
                expected=f"{name}={json.dumps(before[name])}, as in {kept}",
                got=json.dumps(got),
            )


def _plain(node: DictConfig) -> dict[str, Any]:
    """The settings of a node without what they build."""
    values = OmegaConf.to_container(node, resolve=True)
    assert isinstance(values, dict)
    return {str(key): value for key, value in values.items() if not str(key).startswith("_")}


def _part(cfg: DictConfig, items: tuple[Any, ...]) -> list[Any]:
    """Every ``parts``-th item from ``part`` on."""
    if not 0 <= cfg.part < cfg.parts:
        raise InputError("No such part", where="part", expected=f"0 to {cfg.parts - 1}", got=str(cfg.part))
    return list(items[cfg.part :: cfg.parts])


def _parallel(tasks: Sequence[Callable[[], str]], jobs: int) -> Iterable[str]:
    """Results of tasks as they come, several processes at a time."""
    if jobs == 1 or len(tasks) <= 1:
        return (task() for task in tasks)
    from joblib import Parallel, delayed

    results: Iterable[str] = Parallel(n_jobs=jobs, return_as="generator_unordered")(
        delayed(task)() for task in tasks
    )
    return results


def _function(path: str) -> Callable[..., None]:
    """A function by its dotted path."""
    module, _, name = path.rpartition(".")
    try:
        function: Callable[..., None] = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise InputError(
            "No such diagnosis", where="diagnose", expected="package.module.function", got=str(error)
        ) from error
    return function


@contextmanager
def _progress(title: str, total: int) -> Iterator[Callable[[str, str | None], None]]:
    """A bar on a terminal, one line per scene elsewhere."""
    console = Console(stderr=True)
    columns = (TextColumn(title), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task(title, total=total)

        def advance(name: str, failure: str | None) -> None:
            bar.advance(task)
            if failure is not None:
                _log.warning("%s: %s", name, failure)
            elif not console.is_terminal:
                _log.info("%s: done", name)

        yield advance
