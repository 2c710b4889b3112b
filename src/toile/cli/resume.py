"""Continuing an interrupted fit, training or diagnosis."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from toile.cli.alone import OtherSettingsError
from toile.cli.path_arguments import quoted
from toile.errors import InputError
from toile.learning.checkpoints import LAST
from toile.reports.run_folder import RunFolder, read_config, read_metrics
from toile.reports.run_settings import WITHOUT_INFLUENCE, read_settings

_KEY = "resume"
# Settings that may differ between the two halves of a run: they leave the result alone.
_FREE = (*WITHOUT_INFLUENCE, "max_minutes", "workers")
_CHECKPOINT = f"checkpoints/{LAST}"
# What there is to continue from; the results of a diagnosis' stages are looked for one by one.
_BEGUN = {"diagnosis": "config.yaml"}


def resume_arguments(arguments: Sequence[str], what: str) -> list[str]:
    """Replace ``resume=<run folder>`` by the arguments that the run was started with.

    Arguments beside it are added to them.

    Args:
        arguments: of the command line.
        what: "fit", "training" or "diagnosis".

    Raises:
        InputError: the folder holds no run, or nothing to continue from.
    """
    folders = [Path(a.partition("=")[2]) for a in arguments if a.partition("=")[0] == _KEY]
    if not folders:
        return list(arguments)
    folder = folders[-1]
    record, begun = RunFolder(folder).record, _BEGUN.get(what, _CHECKPOINT)
    if record is None or not (folder / begun).is_file():
        raise InputError(
            f"There is no {what} to continue",
            where=str(folder),
            expected=f"a run folder with overrides.yaml and {begun}",
            got="no such folder" if not folder.is_dir() else "a folder without one of them",
        )
    _check_kind(RunFolder(folder), what)
    before = _overrides(record)
    others = [a for a in arguments if a.partition("=")[0] != _KEY]
    return [*before, *others, f"hydra.run.dir={quoted(str(folder))}"]


def _check_kind(folder: RunFolder, what: str) -> None:
    """Refuse the folder of another command."""
    if not folder.config.is_file():
        return
    settings = read_settings(read_config(folder), str(folder.config))
    # A diagnosis has what a fit has, and more.
    found = next((kind for kind in ("training", "diagnosis") if kind in settings), "fit")
    if found != what:
        raise InputError(
            f"There is no {what} to continue",
            where=str(folder.path),
            expected=f"the folder of a {what}",
            got=f"that of a {found}",
        )


def _overrides(record: Path) -> list[str]:
    try:
        overrides = yaml.safe_load(record.read_text(encoding="utf-8")) or []
        if not isinstance(overrides, list):
            raise ValueError(f"a {type(overrides).__name__} at the top level")
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise InputError(
            "The run's overrides cannot be read",
            where=str(record),
            expected="a YAML list of key=value",
            got=" ".join(str(error).split()),
        ) from error
    return [str(override) for override in overrides]


def checkpoint_path(folder: RunFolder) -> Path:
    """Where the last checkpoint of a run is, if it has one."""
    return folder.path / _CHECKPOINT


def is_finished(folder: RunFolder, config: str, last: Path) -> bool:
    """Whether the folder holds everything that a fit with these settings leaves.

    Args:
        folder: of the run; it may be empty.
        config: resolved configuration of this run, YAML text.
        last: what such a fit writes last.

    Raises:
        InputError: the folder holds a run with another configuration.
    """
    if not (folder.config.is_file() and folder.metrics.is_file() and last.is_file()):
        return False
    if "fit" not in read_metrics(folder):
        # An interrupted one that has been evaluated, and has a page, goes on all the same.
        return False
    check_settings_as_before(folder, config)
    return True


def last_checkpoint(folder: RunFolder, config: str) -> Path | None:
    """Checkpoint to continue from, or None for a new run.

    Args:
        folder: of the run; it may hold an interrupted one.
        config: resolved configuration of this run, YAML text.

    Raises:
        InputError: the folder holds a run with another configuration.
    """
    path = checkpoint_path(folder)
    if not path.is_file():
        return None
    check_settings_as_before(folder, config)
    return path


def check_settings_as_before(folder: RunFolder, config: str) -> None:
    """Refuse to go on in a folder with other settings than its own.

    Args:
        folder: of a run.
        config: resolved configuration of this run, YAML text.

    Raises:
        OtherSettingsError: a setting that the result follows from is another one.
    """
    before = _binding(read_settings(read_config(folder), str(folder.config)))
    now = _binding(yaml.safe_load(config))
    changed = sorted(key for key in before.keys() | now.keys() if before.get(key) != now.get(key))
    if changed:
        raise OtherSettingsError(
            "The folder holds a run with other settings",
            where=str(folder.path),
            expected="the settings it was started with, or another folder",
            got="; ".join(f"{key}: {now.get(key)} instead of {before.get(key)}" for key in changed),
        )


def _binding(config: Any, prefix: str = "") -> dict[str, Any]:
    """Settings that a result follows from, flattened: {"scene.name": "R1", ...}.

    Where the package keeps a class is no setting; its name is.
    """
    flat: dict[str, Any] = {}
    for key, value in config.items():
        name = f"{prefix}{key}"
        if name in _FREE:
            continue
        if isinstance(value, dict):
            flat.update(_binding(value, f"{name}."))
        elif key == "_target_" and str(value).startswith("toile."):
            flat[name] = str(value).rpartition(".")[2]
        else:
            flat[name] = value
    return flat
