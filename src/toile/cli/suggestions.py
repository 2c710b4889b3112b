"""What a user may have meant: commands, settings and choices that are nearly what was typed."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from toile import former_names

_NO_KEY = re.compile(r"Could not override '([^']+)'")
_NO_CHOICE = re.compile(r"Could not find '([^']+)/([^'/]+)'")
_NONE_OF_A_LIST = re.compile(r"Could not load '([^']+)/([^'/]+)'")
"""As of effect@candidates=[...], where Hydra names no choices."""


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """``; did you mean 'fit'?`` or ""."""
    names = list(known)
    near = difflib.get_close_matches(word, names, n=1, cutoff=0.6)
    # What was typed so far counts, too: "eval" is far from "evaluate" by its letters alone.
    near = near or ([n for n in names if n.startswith(word)] if len(word) > 2 else [])
    return f"; did you mean {near[0]!r}?" if near else ""


def suggestion(error: Exception, command: str, arguments: Sequence[str]) -> str:
    """A line to add to Hydra's message that a setting or a choice is unknown; "" where nothing is close.

    Args:
        error: as Hydra raised it.
        command: of the command line.
        arguments: flags and overrides that Hydra has seen.
    """
    message = str(error)
    of_list = _NONE_OF_A_LIST.search(message)
    if of_list:
        return _choices(of_list.group(1), of_list.group(2), arguments)
    key, choice = _NO_KEY.search(message), _NO_CHOICE.search(message)
    if not (key or choice):
        return ""
    wrong = key.group(1) if key else choice.group(1) if choice else ""
    name = wrong.partition("@")[0]
    if former_names.setting(name) != name:
        return f"\nIt is called {former_names.setting(name)} now"
    cfg, groups = _without(wrong, command, arguments)
    if key:
        near = _near_key(name, cfg, groups)
    else:
        assert choice is not None
        near = next(iter(difflib.get_close_matches(choice.group(2), groups.get(wrong, []), n=1)), "")
        near = near and f"{wrong}={near}"
    return f"\nDid you mean {near}?" if near else ""


def _choices(group: str, wrong: str, arguments: Sequence[str]) -> str:
    """All choices of a group in Hydra's form, and the nearest to a wrong one."""
    from toile.cli.configuration import CONF
    from toile.cli.groups import group_choices

    more = _arguments(arguments).config_dir
    known = group_choices([CONF] if more is None else [CONF, Path(more)]).get(group, [])
    if not known:
        return ""
    near = difflib.get_close_matches(wrong, known, n=1)
    lines = ["", "", f"Available options in '{group}':", *(f"\t{name}" for name in known)]
    return "\n".join(lines + [f"Did you mean {name}?" for name in near])


def _arguments(arguments: Sequence[str]) -> Any:
    """Flags and overrides as Hydra parses them."""
    # Here, because a wrong command needs none of it.
    from hydra._internal.utils import get_args_parser

    return get_args_parser().parse_args(list(arguments))


def _without(wrong: str, command: str, arguments: Sequence[str]) -> tuple[Any, dict[str, list[str]]]:
    """The command's settings and groups without the override that is wrong."""
    from hydra.errors import HydraException

    from toile.cli.shown import composed

    given = _arguments(arguments)
    others = [o for o in given.overrides if o.lstrip("+~").partition("=")[0].partition("@")[0] != wrong]
    more = None if given.config_dir is None else Path(given.config_dir)
    try:
        return composed(command, others, more)
    except HydraException:
        # Another one is wrong as well; what they choose matters little for the names of settings.
        return composed(command, [], more)


def _near_key(wrong: str, cfg: Any, groups: dict[str, list[str]]) -> str:
    """The known key, or group, nearest to a wrong one: by its parts from the left, else by its last part."""
    from omegaconf import DictConfig, OmegaConf

    if "/" in wrong:
        return next(iter(difflib.get_close_matches(wrong, groups, n=1)), "")
    node, found = cfg, list[str]()
    for part in wrong.split("."):
        if not isinstance(node, DictConfig):
            break
        known = [str(name) for name in node] + ([] if found else list(groups))
        near = [part] if part in known else difflib.get_close_matches(part, known, n=1)
        if not near:
            break
        found.append(near[0])
        node = OmegaConf.select(cfg, ".".join(found), throw_on_missing=False)
    else:
        return ".".join(found)
    last = wrong.rpartition(".")[2]
    keys = [key for key in _keys(cfg) if not key.startswith("hydra.")]
    ends = [key for key in keys if key.rpartition(".")[2] == last]
    # One place of that name is what was meant; several are a guess.
    return (
        ends[0] if len(ends) == 1 else next(iter(difflib.get_close_matches(wrong, keys, n=1, cutoff=0.8)), "")
    )


def _keys(node: Any, prefix: str = "") -> Iterator[str]:
    from omegaconf import DictConfig

    for name, value in node.items_ex(resolve=False):
        key = f"{prefix}{name}"
        yield key
        special = isinstance(value, DictConfig) and (
            value._is_none() or value._is_missing() or value._is_interpolation()
        )
        if isinstance(value, DictConfig) and not special:
            yield from _keys(value, f"{key}.")
