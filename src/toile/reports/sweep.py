"""Several runs read for a comparison."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from toile.errors import InputError
from toile.evaluation.evaluate import EvaluationResult
from toile.reports.run_folder import RunFolder, read_config, read_metrics, read_trajectory
from toile.reports.run_settings import Difference, differences, read_settings

_FIT = "fit"
_RESULTS = {"training": "metrics.json", "diagnosis": "diagnosis.json", _FIT: "metrics.json"}
"""What a run is, by the key of its settings, and what it leaves."""
UNFINISHED = "no metrics.json: interrupted, or still running"
COMPARED_PARAMETERS = ("stretching [N/m]", "shearing [N·m]", "bending [N·m]")
"""Parameters of trajectory.npz whose end values are compared."""
# What every run of a sweep has of its own, or what has a column already.
_NOT_A_CHOICE = ("scene", "scene.name", "seed", "hydra", "paths", "resume")


@dataclass(frozen=True)
class Run:
    """A finished run.

    Attributes:
        folder: where it is.
        name: its path below the sweep's folder.
        evaluation: its metrics.
        settings: its configuration as plain data, empty where it has none.
        overrides: what was asked for on the command line, where that is known.
        parameters: end values of the stiffnesses, by name with unit.
        seconds: time of the fit [s], or None.
        processor_seconds: the same of the processor, or None.
        other_seeds: the same motion measured with other seeds of the metrics' samples.
    """

    folder: RunFolder
    name: str
    evaluation: EvaluationResult
    settings: Mapping[str, Any] = field(default_factory=dict)
    overrides: tuple[str, ...] = ()
    parameters: Mapping[str, float] = field(default_factory=dict)
    seconds: float | None = None
    processor_seconds: float | None = None
    other_seeds: tuple[EvaluationResult, ...] = ()

    @property
    def seed(self) -> str:
        """Seed of the fit, as text; that of the evaluation where the configuration says nothing."""
        return str(self.settings.get("seed", self.evaluation.seed))


@dataclass(frozen=True)
class Unfinished:
    """A run without a result.

    Attributes:
        folder: where it is.
        name: its path below the sweep's folder.
        reason: why, as far as that is known.
        settings: its configuration as plain data, empty where it has none that can be read.
        overrides: what was asked for on the command line, where that is known.
    """

    folder: RunFolder
    name: str
    reason: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    overrides: tuple[str, ...] = ()

    @property
    def scene(self) -> str:
        """Name of the scene, "" where that is not known."""
        scene = self.settings.get("scene")
        name = scene.get("name") if isinstance(scene, Mapping) else None
        return "" if name is None else Path(str(name)).name

    @property
    def asked_for(self) -> str:
        """What was asked for, other than scene, seed and places."""
        return ", ".join(_without_path(o) for o in self.overrides if not _shared(o))


@dataclass(frozen=True)
class Group:
    """Runs that differ in scene and seed only.

    Attributes:
        label: what sets them apart from the others.
        runs: at least one.
    """

    label: str
    runs: tuple[Run, ...]


@dataclass(frozen=True)
class Sweep:
    """Runs side by side.

    Attributes:
        folder: the folder they are all below.
        runs: finished ones, by name.
        unfinished: the others.
        differences: settings in which the finished runs differ, other than scene and seed.
        all_differences: the same with unfinished runs that have a configuration; values of the finished runs
            come first, then those of all unfinished ones, "" where nothing is known.
        groups: the finished runs by those settings.
    """

    folder: Path
    runs: tuple[Run, ...]
    unfinished: tuple[Unfinished, ...]
    differences: tuple[Difference, ...]
    all_differences: tuple[Difference, ...]
    groups: tuple[Group, ...]

    @property
    def scenes(self) -> list[str]:
        """Names of the scenes, in order of the runs."""
        return list(dict.fromkeys(run.evaluation.scene for run in self.runs))


def outcomes(folder: Path) -> tuple[int, list[Unfinished]]:
    """How many runs in and below a folder have a result, fits or not, and those that have none."""
    finished, unfinished = 0, []
    for path in _run_folders(folder, kinds=tuple(_RESULTS)):
        run, name = RunFolder(path), _name(path, folder)
        kind = _kind(path)
        read = _read(run, name) if kind == _FIT else _read_other(run, name, _RESULTS[kind])
        if isinstance(read, Unfinished):
            unfinished.append(read)
        else:
            finished += 1
    return finished, unfinished


def read_sweep(folders: Sequence[Path]) -> Sweep:
    """Read all fits in and below some folders.

    Args:
        folders: run folders, or folders that hold run folders at any depth.

    Raises:
        InputError: there is no fit below one of them.
    """
    found: dict[Path, None] = {}
    for folder in folders:
        below = list(_run_folders(folder))
        if not below:
            raise InputError(
                "Not a folder of a fit, and no fit below it",
                where=str(folder),
                expected="a folder with metrics.json or config.yaml, or one that holds such folders",
                got="a folder without any" if folder.is_dir() else "no such folder",
            )
        found.update(dict.fromkeys(path.resolve() for path in below))
    common = folders[0].resolve() if len(folders) == 1 else Path(os.path.commonpath(list(found)))
    read = [_read(RunFolder(path), _name(path, common)) for path in sorted(found)]
    runs = tuple(r for r in read if isinstance(r, Run))
    unfinished = tuple(r for r in read if isinstance(r, Unfinished))
    scenes = [r.evaluation.scene for r in runs]
    chosen = [d for d in differences([r.settings for r in runs]) if _is_choice(d, scenes)]
    return Sweep(
        folder=common,
        runs=runs,
        unfinished=unfinished,
        differences=tuple(chosen),
        all_differences=_all_differences(runs, unfinished),
        groups=_groups(runs, chosen),
    )


def _all_differences(runs: Sequence[Run], unfinished: Sequence[Unfinished]) -> tuple[Difference, ...]:
    """See Sweep.all_differences."""
    known = [u for u in unfinished if u.settings]
    scenes = [*(r.evaluation.scene for r in runs), *(u.scene for u in known)]
    found = []
    for d in differences([*(r.settings for r in runs), *(u.settings for u in known)]):
        if _is_choice(d, scenes):
            others = iter(d.values[len(runs) :])
            values = [next(others) if u.settings else "" for u in unfinished]
            found.append(replace(d, values=(*d.values[: len(runs)], *values)))
    return tuple(found)


def _is_choice(difference: Difference, scenes: Sequence[str]) -> bool:
    """Whether runs differ in it by choice: not the seed, the scene, or what goes with the scene."""
    path = difference.paths[0]
    if not path.startswith("scene."):
        return path != "seed"
    values: dict[str, set[str]] = {}
    for scene, value in zip(scenes, difference.values, strict=True):
        values.setdefault(scene, set()).add(value)
    return path != "scene.name" and any(len(found) > 1 for found in values.values())


def _run_folders(folder: Path, kinds: Sequence[str] = (_FIT,)) -> Iterator[Path]:
    """Folders of runs in and below a folder, hidden ones left out; a run holds no other run."""
    for place, folders, files in os.walk(folder):
        if {"metrics.json", "config.yaml", "failure.txt"} & set(files):
            folders.clear()
            if _kind(Path(place)) in kinds:
                yield Path(place)
        folders[:] = sorted(f for f in folders if not f.startswith("."))


def _kind(folder: Path) -> str:
    """What a run is, see _RESULTS; one that does not say counts as a fit."""
    run = RunFolder(folder)
    if not run.config.is_file():
        return _FIT
    try:
        settings = read_settings(read_config(run), str(run.config))
    except InputError:
        return _FIT
    return next((kind for kind in _RESULTS if kind != _FIT and kind in settings), _FIT)


def _read_other(folder: RunFolder, name: str, result: str) -> RunFolder | Unfinished:
    """A run that is no fit, as far as it goes."""
    if folder.failure.is_file():
        text = folder.failure.read_text(encoding="utf-8", errors="replace").strip()
        return _unfinished(folder, name, _last_words(text))
    if not (folder.path / result).is_file():
        return _unfinished(folder, name, f"no {result}: interrupted, or still running")
    return folder


def _name(path: Path, common: Path) -> str:
    return path.relative_to(common).as_posix() if path != common else path.name


def _read(folder: RunFolder, name: str) -> Run | Unfinished:
    """A run as far as it goes; one that cannot be read is unfinished, with the message as reason."""
    try:
        if folder.failure.is_file():
            text = folder.failure.read_text(encoding="utf-8", errors="replace").strip()
            return _unfinished(folder, name, _last_words(text))
        if not folder.metrics.is_file():
            return _unfinished(folder, name, UNFINISHED)
        metrics = read_metrics(folder)
        evaluation = EvaluationResult.from_dict(metrics)
        settings = read_settings(read_config(folder), str(folder.config)) if folder.config.is_file() else {}
        fit = metrics.get("fit")
        return Run(
            folder,
            name,
            evaluation,
            settings,
            _overrides(folder),
            _parameters(folder),
            _number(fit, "seconds of the fit"),
            _number(fit, "processor seconds of the fit"),
        )
    except InputError as error:
        return _unfinished(folder, name, str(error))


def _number(fit: Any, name: str) -> float | None:
    value = fit.get(name) if isinstance(fit, Mapping) else None
    return float(value) if isinstance(value, int | float) else None


def _unfinished(folder: RunFolder, name: str, reason: str) -> Unfinished:
    """With its settings as far as they can be read; that they cannot is not why it has no result."""
    try:
        settings = read_settings(read_config(folder), str(folder.config))
    except InputError:
        settings = {}
    return Unfinished(folder, name, reason, settings, _overrides(folder))


def _last_words(text: str) -> str:
    """The message, or the last line of a traceback."""
    lines = text.splitlines() or ["failed without a message"]
    return lines[-1] if lines[0].startswith("Traceback") else text


def _parameters(folder: RunFolder) -> dict[str, float]:
    if not folder.trajectory.is_file():
        return {}
    saved = read_trajectory(folder).parameters
    return {n: float(saved[n]) for n in COMPARED_PARAMETERS if n in saved and np.size(saved[n]) == 1}


def _overrides(folder: RunFolder) -> tuple[str, ...]:
    """What the run was started with."""
    record = folder.record
    if record is None:
        return ()
    try:
        given = yaml.safe_load(record.read_text(encoding="utf-8"))
    except (OSError, ValueError, yaml.YAMLError):
        return ()
    return tuple(map(str, given)) if isinstance(given, list) else ()


def _groups(runs: Sequence[Run], chosen: Sequence[Difference]) -> tuple[Group, ...]:
    members: dict[tuple[str, ...], list[Run]] = {}
    told_apart = [_besides_the_scene(d, runs) for d in chosen]
    for k, run in enumerate(runs):
        members.setdefault(tuple(values[k] for values in told_apart), []).append(run)
    labels = [_asked_for(found, runs) for found in members.values()]
    if len(set(labels)) < len(labels):
        # Not asked for in so many words: then what the configurations say.
        labels = [
            ", ".join(f"{d.name} = {v}" for d, v in zip(chosen, values, strict=True)) for values in members
        ]
    named = zip(labels, members.values(), strict=True)
    return tuple(Group(label or "all runs", tuple(found)) for label, found in named)


def _besides_the_scene(difference: Difference, runs: Sequence[Run]) -> tuple[str, ...]:
    """The values of a difference, or "" where one is what most runs of the same scene have.

    Scenes bring settings of their own, which do not make another group of the same ablation.
    """
    if not difference.paths[0].startswith("scene."):
        return difference.values
    found: dict[str, Counter[str]] = {}
    for run, value in zip(runs, difference.values, strict=True):
        found.setdefault(run.evaluation.scene, Counter())[value] += 1
    usual = {scene: counts.most_common(1)[0][0] for scene, counts in found.items()}
    own = zip(runs, difference.values, strict=True)
    return tuple("" if value == usual[run.evaluation.scene] else value for run, value in own)


def _asked_for(members: Sequence[Run], runs: Sequence[Run]) -> str:
    """What was asked for in a group and not in all runs, e.g. "ablation=no_turbulence"."""
    everywhere = set(runs[0].overrides).intersection(*(r.overrides for r in runs))
    within = set(members[0].overrides).intersection(*(r.overrides for r in members))
    own = [o for o in members[0].overrides if o in within - everywhere and not _shared(o)]
    return ", ".join(map(_without_path, own)) or ("as configured" if len(members) < len(runs) else "")


def _without_path(override: str) -> str:
    """Short enough for a label: "turbulence=1", not "optimization.stages.track.priors.turbulence=1"."""
    key, equals, value = override.partition("=")
    return key.rpartition(".")[2] + equals + value if equals else override


def _shared(override: str) -> bool:
    key = override.lstrip("+~").partition("=")[0]
    return key in _NOT_A_CHOICE or key.partition(".")[0] in ("hydra", "paths")
