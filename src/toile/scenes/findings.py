"""Findings about a scene: what loaders raise and the doctor lists."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import TypeVar

from toile.errors import InputError

T = TypeVar("T")

NAMED = 10
"""Frames named in a message."""


class Severity(StrEnum):
    """How bad a finding is: an error stops the loader, a warning harms the result."""

    ERROR = "error"
    WARNING = "warning"
    INFO = "info"


@dataclass(frozen=True)
class Finding:
    """One observation about a scene.

    Attributes:
        severity: error, warning or info.
        what: what is wrong or remarkable, in a few words.
        where: file, key, frame or vertex.
        expected: what was expected there.
        got: what was found.
    """

    severity: Severity
    what: str
    where: str
    expected: str
    got: str

    def __str__(self) -> str:
        return f"[{self.severity}] {self.what} ({self.where}): expected {self.expected}; got {self.got}"

    def to_error(self) -> InputError:
        """The exception a loader raises for it."""
        return InputError(self.what, where=self.where, expected=self.expected, got=self.got)

    @staticmethod
    def of_error(error: InputError) -> Finding:
        """The finding that records an exception raised by a loader."""
        return Finding(Severity.ERROR, error.what, error.where, error.expected, error.got)


def named(frames: Sequence[int]) -> str:
    """The first frames of a list for a message: "frames 3, 4 and 12 more"."""
    more = f" and {len(frames) - NAMED} more" if len(frames) > NAMED else ""
    return f"frame{'s' if len(frames) > 1 else ''} {', '.join(map(str, frames[:NAMED]))}{more}"


def require(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Raise InputError for the first error among the findings; return the others."""
    findings = tuple(findings)
    for finding in findings:
        if finding.severity is Severity.ERROR:
            raise finding.to_error()
    return findings


def is_warning(note: str) -> bool:
    """Whether a note of a scene is a warning, as loaders put it there."""
    return note.startswith(f"[{Severity.WARNING}]")


def has_errors(findings: Iterable[Finding]) -> bool:
    """Whether any finding is an error."""
    return any(finding.severity is Severity.ERROR for finding in findings)


def attempt(findings: list[Finding], read: Callable[[], T]) -> T | None:
    """Call ``read``; on InputError append the finding and return None."""
    try:
        return read()
    except InputError as error:
        findings.append(Finding.of_error(error))
        return None
