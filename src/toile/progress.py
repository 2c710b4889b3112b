"""How far a long piece of work is: a bar on a terminal, a line now and then in the log elsewhere."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Protocol, TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

T = TypeVar("T")
SECONDS_BETWEEN_LINES = 10.0
"""Where there is no terminal; work that is done sooner says nothing."""


class Report(Protocol):
    """Takes how far some work is."""

    def __call__(self, what: str, done: int, total: int | None, state: str = "") -> None:
        """Say that ``done`` of ``total`` (None: nobody knows) parts of ``what`` are done."""


def silent(what: str, done: int, total: int | None, state: str = "") -> None:
    """A report that nobody reads."""


class Lines:
    """A line in the log whenever ten seconds have passed, with the time left.

    Args:
        log: where to.
        clock: seconds; for tests.
    """

    def __init__(self, log: logging.Logger, clock: Callable[[], float] = time.monotonic) -> None:
        self._log = log
        self._clock = clock
        self._what: str | None = None
        self._said = clock()
        self._first: tuple[int, float] | None = None
        self._done_before = 0

    def __call__(self, what: str, done: int, total: int | None, state: str = "") -> None:
        """As Report."""
        now = self._clock()
        if what != self._what:
            self._what, self._first, self._done_before = what, None, done
        if self._first is None and done > self._done_before:
            # The first part takes longer, because much is loaded and compiled for it.
            self._first = done, now
        if now - self._said < SECONDS_BETWEEN_LINES:
            return
        self._said = now
        parts = f"{done}" if total is None else f"{done} of {total}"
        left = ""
        if total is not None and self._first is not None and done > self._first[0]:
            seconds = (now - self._first[1]) / (done - self._first[0]) * (total - done)
            left = f", about {_duration(seconds)} left"
        self._log.info("%s: %s%s%s", what, parts, left, f", {state}" if state else "")

    def said(self) -> None:
        """Somebody else has just written a line that says as much."""
        self._said = self._clock()


class Shown:
    """A bar with the time left on a terminal; Lines elsewhere. A context manager.

    Args:
        log: of the lines.
        console: of the bar; None for standard error.
        leave: whether the bar stays when the work is done.
    """

    def __init__(self, log: logging.Logger, console: Console | None = None, leave: bool = False) -> None:
        console = console or Console(stderr=True)
        self._lines = None if console.is_terminal else Lines(log)
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=12 if leave else 40),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.fields[state]}"),
            console=console,
            transient=not leave,
        )
        self._task: TaskID | None = None
        self._what = ""

    def __enter__(self) -> Shown:
        if self._lines is None:
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._lines is None:
            self._bar.stop()

    @property
    def as_lines(self) -> bool:
        """Whether it is lines in the log."""
        return self._lines is not None

    def said(self) -> None:
        """Somebody else has just written a line that says as much."""
        if self._lines is not None:
            self._lines.said()

    def __call__(self, what: str, done: int, total: int | None, state: str = "") -> None:
        """As Report."""
        if self._lines is not None:
            self._lines(what, done, total, state)
            return
        if self._task is None or what != self._what:
            if self._task is not None:
                self._bar.remove_task(self._task)
            self._task, self._what = self._bar.add_task(what, total=total, state=state), what
        self._bar.update(self._task, completed=done, state=state)


def counted(items: Iterable[T], report: Report, what: str, total: int | None) -> Iterator[T]:
    """The items, reported as they are taken and done with."""
    report(what, 0, total)
    for done, item in enumerate(items, 1):
        yield item
        report(what, done, total)


def _duration(seconds: float) -> str:
    if seconds < 60:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
