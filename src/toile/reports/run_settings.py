"""What differs between the configurations of several runs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import yaml

from toile.errors import InputError

MAX_BYTES = 200_000
MAX_DEPTH = 20
"""A configuration is small and flat; aliases in a hostile file could make it neither."""
WITHOUT_INFLUENCE = ("callbacks", "logger", "objective", "paths", "report", "scene.data_dir", "trainer")
"""Parts that leave the result alone."""
MAX_TEXT = 40


@dataclass(frozen=True)
class Difference:
    """A setting that is not the same in all runs.

    Attributes:
        name: as short as it can be without becoming ambiguous.
        path: in full, e.g. "optimization.stages.track.term.mask_weight"; several if they always agree.
        values: for every run, as text.
    """

    name: str
    paths: tuple[str, ...]
    values: tuple[str, ...]


def read_settings(text: str, where: str) -> dict[str, Any]:
    """Parse a stored configuration as plain data.

    Args:
        text: YAML.
        where: file it comes from, for messages.

    Raises:
        InputError: no YAML, no mapping, or too large to be a configuration.
    """
    try:
        if len(text) > MAX_BYTES or any(isinstance(t, yaml.AliasToken) for t in yaml.scan(text)):
            raise ValueError("too large, or with aliases")
        settings = yaml.safe_load(text)
        if not isinstance(settings, dict):
            raise ValueError(f"a {type(settings).__name__} at the top level")
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise InputError(
            "The run's configuration cannot be read",
            where=where,
            expected=f"a YAML mapping of at most {MAX_BYTES} characters without aliases",
            got=str(error),
        ) from error
    return settings


def differences(settings: Sequence[Mapping[str, Any]]) -> list[Difference]:
    """The settings in which runs differ, most general first; the seed and the scene's name among them.

    A part that only some runs have is one difference, not one per setting in it; so is a part that is built
    by another class.
    """
    found: dict[str, tuple[str, ...]] = {}
    _compare([dict(s) for s in settings], "", found)
    # Settings that always agree, such as one number in two stages, are shown once.
    merged: dict[tuple[str, tuple[str, ...]], list[str]] = {}
    for path, values in found.items():
        merged.setdefault((path.rpartition(".")[2], values), []).append(path)
    last = Counter(name for name, _ in merged)
    result = []
    for (name, values), paths in merged.items():
        short = name if last[name] == 1 else paths[0]
        result.append(Difference(short, tuple(paths), values))
    return sorted(result, key=lambda d: (d.paths[0].count("."), d.paths[0]))


def _compare(nodes: Sequence[Any], path: str, found: dict[str, tuple[str, ...]]) -> None:
    if path in WITHOUT_INFLUENCE or path.count(".") > MAX_DEPTH or all(n == nodes[0] for n in nodes[1:]):
        return
    if all(isinstance(n, dict) for n in nodes) and len({str(n.get("_target_")) for n in nodes}) == 1:
        for key in dict.fromkeys(key for node in nodes for key in node):
            children = [node.get(key, _MISSING) for node in nodes]
            _compare(children, f"{path}.{key}" if path else str(key), found)
    else:
        found[path] = tuple(map(_text, nodes))


class _Missing:
    """Stands for a setting that a run does not have."""


_MISSING = _Missing()


def _text(value: Any) -> str:
    match value:
        case _Missing():
            text = "–"
        case None:
            text = "none"
        case bool():
            text = "yes" if value else "no"
        case float():
            text = f"{value:.4g}"
        case {"_target_": target}:
            text = str(target).rpartition(".")[2]
        case dict():
            text = "given"
        case list():
            text = ", ".join(map(_text, value))
        case _:
            text = str(value)
    return text if len(text) <= MAX_TEXT else text[: MAX_TEXT - 1] + "…"
