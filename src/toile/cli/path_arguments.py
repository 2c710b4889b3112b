"""Paths on the command line as they are: with spaces, commas, "=" and letters of any alphabet.

Hydra's grammar gives such characters a meaning (a comma sweeps, "=" and "(" end a value) or refuses them.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import QuotedString
from hydra.errors import HydraException

from toile.errors import InputError

# Settings that hold a path, by their last part; "scene" has rules of its own.
_PATHS = {
    "data",
    "data_dir",
    "dir",
    "file",
    "folder",
    "key",
    "landmarks",
    "mesh",
    "outputs",
    "output",
    "predictions",
    "result",
    "run",
    "session",
    "still",
    "video",
    "weights",
}
_DELIBERATE = re.compile(r"""['"\[{]|\w+\(|.*\$\{""")
"""How a value begins that is meant to be Hydra's: quoted, a list, a function, a reference."""


class _Unreadable:
    """Stands for a value that is none in Hydra's grammar."""


UNREADABLE = _Unreadable()


def quote_paths(arguments: Sequence[str]) -> list[str]:
    """Put quotes around values that are paths and would be read as something else.

    A value that exists as it stands is a path, whatever the setting. In a setting that holds a path, so is
    one that Hydra's grammar refuses, or would turn into a number. Lists, sweeps, quotes, references and
    functions stay Hydra's.

    Args:
        arguments: of the command line; flags and arguments without "=" are left alone.

    Raises:
        InputError: one that begins with "=".
    """
    nameless = [argument for argument in arguments if argument.startswith("=")]
    if nameless:
        raise InputError(
            "An override without a name", where="command line", expected="key=value", got=nameless[0]
        )
    return [_path_quoted(argument) for argument in arguments]


def quoted(text: str) -> str:
    """Text in Hydra's quotes."""
    return "'" + text.replace("\\", "\\\\").replace("'", "\\'") + "'"


def exists(path: str) -> bool:
    """Whether there is such a file or folder; text that no file system takes (too long, NUL) names none."""
    try:
        return Path(path).exists()
    except (OSError, ValueError):
        return False


def parsed(value: str) -> Any:
    """What Hydra's grammar makes of a value: text, number, QuotedString, sweep, ...; else ``UNREADABLE``."""
    try:
        return _parser().parse_rule(f"x={value}", "override")._value
    except HydraException:
        return UNREADABLE


def _path_quoted(argument: str) -> str:
    key, equals, value = argument.partition("=")
    if not equals or not value or argument.startswith(("-", "~")) or key == "scene":
        return argument
    meaning = parsed(value)
    # report.video=false is a switch, though video=<file> is a path.
    if isinstance(meaning, QuotedString | bool) or meaning == value:
        return argument
    is_path = key.rpartition(".")[2].lstrip("+") in _PATHS
    taken_wrongly = meaning is UNREADABLE or isinstance(meaning, int | float | str)
    if exists(value):
        # Of what is no path by its name, only what Hydra would refuse: a file called 0,1 is no seed=0,1.
        wrong = is_path or meaning is UNREADABLE
    else:
        wrong = is_path and taken_wrongly and not _DELIBERATE.match(value)
    return f"{key}={quoted(value)}" if wrong else argument


@cache
def _parser() -> OverridesParser:
    return OverridesParser.create()
