"""One bad input: what is wrong, the command, and what a good answer to it is."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path


class Want(StrEnum):
    """What a good answer is."""

    COMPLAINT = "complaint"
    """Refused in one clear message, or done with a warning that cannot be missed."""
    REFUSAL = "refusal"
    """Refused; a warning is not enough."""
    SUCCESS = "success"
    """It is unusual, but nothing is wrong with it: it must work."""


def nothing(folder: Path) -> None:
    """Prepare nothing."""


@dataclass(frozen=True)
class Case:
    """A bad input.

    Every case has a folder of its own, which is the current one of its commands: a copy of the stock, see
    ``stock``.

    Attributes:
        group: heading in the table.
        wrong: what is wrong, in words.
        arguments: of toile.
        prepare: breaks something in the folder.
        says: words that a clear message holds, in upper or lower case; each may be alternatives "a|b".
        want: what a good answer is.
        environment: variables besides those of the caller; "" removes one.
        process: start a real process, where the start is what matters; else a fork of one that has imported
            toile.
        disk: the folder "disk" is a file system of its own, with so many bytes; None: it is none.
        read_only: the folder "disk" cannot be written to once it is prepared.
        before: a command that must succeed before, e.g. so that there is something to continue.
        beside: a command that runs meanwhile, and must succeed.
        ready: what must be there before the command is started beside that one, a pattern.
        keeps: patterns of files that must be the same bytes afterwards.
        then: commands that must succeed afterwards.
        leaves: patterns of files that a success leaves.
        at_most: seconds that a command may take.
        harmless: it does not touch the result, so that a warning on the console is enough.
    """

    group: str
    wrong: str
    arguments: tuple[str, ...]
    prepare: Callable[[Path], None] = nothing
    says: tuple[str, ...] = ()
    want: Want = Want.COMPLAINT
    environment: Mapping[str, str] = field(default_factory=dict)
    process: bool = False
    disk: int | None = None
    read_only: bool = False
    before: tuple[str, ...] = ()
    beside: tuple[str, ...] = ()
    ready: str = ""
    keeps: tuple[str, ...] = ()
    then: tuple[tuple[str, ...], ...] = ()
    leaves: tuple[str, ...] = ()
    at_most: float = 120.0
    harmless: bool = False
