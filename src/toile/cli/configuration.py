"""Composing, instantiating and storing configurations."""

from __future__ import annotations

import importlib.resources
import re
from collections.abc import Sequence
from dataclasses import fields, is_dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import hydra.utils
import yaml
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.types import QuotedString
from omegaconf import Container, DictConfig, ListConfig, OmegaConf

from toile.cli.commands import COMMANDS
from toile.cli.path_arguments import UNREADABLE, exists, parsed, quoted
from toile.errors import InputError

CONF = Path(str(importlib.resources.files("toile.conf")))
"""The configuration that comes with the package: conf/ at the top of the repository."""

_HYDRA_SYNTAX = re.compile(r"""[()\[\]{}$'"=]""")
_FLAGS_WITH_VALUE = {
    *("--cfg", "-c", "--info", "-i", "--package", "-p", "--experimental-rerun"),
    *("--config-dir", "-cd", "--config-name", "-cn", "--config-path", "-cp"),
}
# A run folder may come from somebody else: from its configuration, only these are ever called.
_SCENE_TARGETS = {
    "toile.scenes.registry.load_scene",
    "toile.scenes.texture_coordinates.from_file",
    "toile.scenes.texture_coordinates.projected",
}


def register_resolvers() -> None:
    """Make ``${basename:path}``, ``${file_names:paths}`` and ``${summary:command}`` known, once or again."""
    OmegaConf.register_new_resolver("basename", lambda path: Path(str(path)).name, replace=True)
    OmegaConf.register_new_resolver("file_names", _file_names, replace=True)
    OmegaConf.register_new_resolver("summary", lambda name: COMMANDS[name].summary, replace=True)


def _file_names(paths: str | ListConfig) -> ListConfig:
    """Names of files without their suffixes."""
    return ListConfig([Path(str(path)).stem for path in ([paths] if isinstance(paths, str) else paths)])


def flags_first(arguments: Sequence[str]) -> list[str]:
    """Flags such as -m may stand anywhere; Hydra's parser wants all overrides in one piece."""
    flags: list[str] = []
    overrides: list[str] = []
    for before, argument in pairwise(["", *arguments]):
        flag = argument.startswith("-") or before in _FLAGS_WITH_VALUE
        (overrides if not flag and ("=" in argument or argument.startswith("~")) else flags).append(argument)
    return [*flags, *overrides]


def name_scenes(arguments: Sequence[str]) -> list[str]:
    """Let ``scene=`` take any name or folder: what is no file in conf/scene becomes native with that name.

    ``scene=R1,a1cb40`` becomes ``scene=native scene.name='R1','a1cb40'`` unless both are files. A folder that
    exists, and what is no value in Hydra's grammar, is one name, whatever characters it has; brackets and
    functions of Hydra are left alone.
    """
    known = {
        path.stem for folder in (CONF, *_config_folders(arguments)) for path in folder.glob("scene/*.yaml")
    }
    result: list[str] = []
    for argument in arguments:
        key, _, value = argument.partition("=")
        names = value.split(",")
        if key != "scene" or not value or value == "null" or known.issuperset(names):
            result.append(argument)
            continue
        meaning = parsed(value) if _HYDRA_SYNTAX.search(value) else None
        if isinstance(meaning, QuotedString):
            names = [meaning.text]
        elif exists(value) or meaning is UNREADABLE:
            names = [value]
        elif meaning is not None:
            result.append(argument)
            continue
        result += ["scene=native", f"scene.name={','.join(map(quoted, names))}"]
    return result


def name_sessions(arguments: Sequence[str]) -> list[str]:
    """Let ``session=`` name a scene as well where none is named: run folders are called after it.

    A session's path becomes absolute, as ``resume=`` may be called from anywhere. Of a sweep every job has
    its own.
    """
    pairs = [argument.partition("=") for argument in arguments]
    named = [value for key, _, value in pairs if key == "session" and value not in ("", "null")]
    if not named or any(key in ("scene", "scene.name") for key, _, _ in pairs):
        return list(arguments)
    # Of several the last one counts.
    path = parsed(named[-1]) if _HYDRA_SYNTAX.search(named[-1]) else None
    text = path.text if isinstance(path, QuotedString) else named[-1]
    if "," in text and not isinstance(path, QuotedString) and not Path(text).expanduser().exists():
        return [*arguments, "scene.name=${session}"]
    whole = quoted(str(Path(text).expanduser().resolve()))
    others = [argument for argument, (key, _, _) in zip(arguments, pairs, strict=True) if key != "session"]
    return [*others, f"session={whole}", f"scene.name={whole}"]


def renamed_arguments(arguments: Sequence[str], aliases: Sequence[tuple[str, str]]) -> list[str]:
    """Arguments with the names that settings and groups really have: ``set=a`` becomes ``blind=a``.

    Args:
        arguments: of the command line.
        aliases: pairs of the other name and the real one.
    """
    names = dict(aliases)
    pairs = [argument.partition("=") for argument in arguments]
    return [names.get(name, name) + equals + value if equals else name for name, equals, value in pairs]


def name_plain_arguments(arguments: Sequence[str], setting: str) -> list[str]:
    """Let arguments without "=" stand for a setting: ``a b`` becomes ``run=['a','b']``, ``a`` ``run='a'``.

    Args:
        arguments: of the command line.
        setting: of the command, e.g. "run"; "" leaves the arguments alone.
    """
    plain: list[str] = []
    others: list[str] = []
    for before, argument in pairwise(["", *arguments]):
        flag = argument.startswith(("-", "~")) or before in _FLAGS_WITH_VALUE
        # A folder may well be called seed=0.
        override = "=" in argument and not exists(argument)
        (others if flag or override or not setting else plain).append(argument)
    if not plain:
        return list(arguments)
    values = ",".join(map(quoted, plain))
    return [*others, f"{setting}={values}" if len(plain) == 1 else f"{setting}=[{values}]"]


def instantiate(node: Any) -> Any:
    """Build what ``_target_`` names from plain Python values; in settings, lists become tuples.

    Raises:
        InputError: a value that its annotation does not allow.
    """
    from toile.cli.settings import check_arguments  # loads pydantic, which --help need not wait for

    if isinstance(node, dict | list):
        node = OmegaConf.create(node)  # parts of it may be configurations
    if isinstance(node, Container):
        check_arguments(OmegaConf.to_container(node, resolve=True))
    return _with_tuples(None if node is None else hydra.utils.instantiate(node, _convert_="all"))


def resolved_yaml(cfg: DictConfig) -> str:
    """The configuration as YAML text with every reference resolved."""
    return OmegaConf.to_yaml(cfg, resolve=True)


def output_folder() -> Path:
    """The folder Hydra made for this run."""
    return Path(HydraConfig.get().runtime.output_dir)


def scene_settings(cfg: DictConfig, run_config: str, where: Path) -> DictConfig:
    """The scene a command is asked for, else the one a run was made with.

    Args:
        cfg: configuration of the command; its ``scene`` may be missing.
        run_config: configuration text of the run.
        where: file of that text, for messages.

    Returns:
        Configuration of the scene; data is looked for where ``cfg`` says, wherever the run was made.

    Raises:
        InputError: the text is no YAML, or names no scene.
    """
    if cfg.get("scene") is not None:
        return cfg.scene
    expected = "the scene that the run was made with; scene=<name> gives another"
    try:
        saved = yaml.safe_load(run_config)
    except yaml.YAMLError as error:
        raise InputError(
            "The run's configuration is no YAML", where=str(where), expected=expected, got=str(error)
        ) from error
    settings = saved.get("scene") if isinstance(saved, dict) else None
    if not isinstance(settings, dict):
        raise InputError("The run names no scene", where=str(where), expected=expected, got=str(settings))
    unexpected = _targets(settings) - _SCENE_TARGETS
    if "${" in str(settings):
        # A stored configuration is resolved; references could build anything.
        unexpected.add("a reference ${...}")
    if unexpected:
        raise InputError(
            "The run's scene is built by something unknown",
            where=str(where),
            expected=", ".join(sorted(_SCENE_TARGETS)),
            got=", ".join(sorted(unexpected)),
        )
    return OmegaConf.create({**settings, "data_dir": cfg.paths.data})


def _with_tuples(value: Any) -> Any:
    """Frozen settings with tuples where YAML, which has none, gave lists."""
    if isinstance(value, list):
        return tuple(map(_with_tuples, value))
    if is_dataclass(value) and not isinstance(value, type):
        old = {f.name: getattr(value, f.name) for f in fields(value) if f.init}
        new = {name: _with_tuples(part) for name, part in old.items()}
        changed = {name: part for name, part in new.items() if part is not old[name]}
        return replace(value, **changed) if changed else value
    return value


def _targets(node: Any) -> set[str]:
    if isinstance(node, dict):
        own = {str(node["_target_"])} if "_target_" in node else set()
        return own.union(*map(_targets, node.values()))
    if isinstance(node, list):
        return set().union(*map(_targets, node))
    return set()


def _config_folders(arguments: Sequence[str]) -> list[Path]:
    """Folders given by --config-dir."""
    found = []
    for argument, following in pairwise([*arguments, ""]):
        flag, equals, value = argument.partition("=")
        if flag in ("--config-dir", "-cd"):
            found.append(Path(value if equals else following))
    return found


# Here, because a launcher's worker process imports this module and calls nothing.
register_resolvers()
