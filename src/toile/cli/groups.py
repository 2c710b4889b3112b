"""Groups of the configuration and their choices, read from its folders: quicker than asking Hydra."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path


def group_choices(folders: Sequence[Path]) -> dict[str, list[str]]:
    """Choices of every group but Hydra's own: ``{"simulator": ["hybrid", ...], "windows": ...}``.

    Args:
        folders: of the configuration; one that does not exist has no groups.
    """
    found: dict[str, set[str]] = {}
    for folder in folders:
        for file in folder.rglob("*.yaml"):
            group = file.parent.relative_to(folder).as_posix()
            if group != "." and group.partition("/")[0] != "hydra":
                found.setdefault(group, set()).add(file.stem)
    return {group: sorted(found[group]) for group in sorted(found)}


def groups_of(choices: Mapping[str, Sequence[str]], chosen: Iterable[str]) -> dict[str, list[str]]:
    """The groups that a command takes: those it has chosen from, and what lies below them.

    Args:
        choices: of all groups.
        chosen: groups as Hydra notes them at run time, e.g. "loss" or "effect@candidates".
    """
    own = {name.partition("@")[0] for name in chosen}
    return {
        group: list(names)
        for group, names in choices.items()
        if any(group == name or group.startswith(f"{name}/") for name in own)
    }
