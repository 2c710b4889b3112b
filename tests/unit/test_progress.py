"""Bars on a terminal, lines in a log."""

from __future__ import annotations

import io
import logging

import pytest
from rich.console import Console

from toile.progress import Lines, Shown, counted, silent


class Clock:
    """Time that passes when told to."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def log() -> logging.Logger:
    logger = logging.getLogger("progress under test")
    logger.setLevel(logging.INFO)
    return logger


def test_a_line_every_ten_seconds_with_the_time_left(log, caplog) -> None:
    clock = Clock()
    lines = Lines(log, clock)
    lines("masks", 0, 50)
    for done in range(1, 51):
        # Much is loaded for the first one, which says nothing about the others.
        clock.now += 30.0 if done == 1 else 2.0
        lines("masks", done, 50)
    assert len(caplog.messages) == 10
    assert caplog.messages[0] == "masks: 1 of 50"
    assert caplog.messages[5] == "masks: 26 of 50, about 48 s left"
    assert caplog.messages[6] == "masks: 31 of 50, about 38 s left"


def test_quick_work_says_nothing(log, caplog) -> None:
    clock = Clock()
    lines = Lines(log, clock)
    for done in range(9):
        clock.now += 1.0
        lines("frames", done, 9)
    assert caplog.messages == []


def test_stages_are_timed_on_their_own(log, caplog) -> None:
    clock = Clock()
    lines = Lines(log, clock)
    lines("simulation", 0, 10)
    clock.now = 1000.0
    lines("simulation", 10, 10)
    lines("frames", 0, 40)
    clock.now = 1001.0
    lines("frames", 1, 40)
    clock.now = 1021.0
    lines("frames", 11, 40, "loss 3")
    assert caplog.messages[-1] == "frames: 11 of 40, about 58 s left, loss 3"
    clock.now = 1201.0
    lines("frames", 12, 40)
    assert caplog.messages[-1] == "frames: 12 of 40, about 8 min left"


def test_what_goes_on_is_timed_from_there(log, caplog) -> None:
    clock = Clock()
    lines = Lines(log, clock)
    lines("cycle", 90, 100)
    clock.now = 5.0
    lines("cycle", 91, 100)
    clock.now = 11.0
    lines("cycle", 92, 100)
    assert caplog.messages == ["cycle: 92 of 100, about 48 s left"]


def test_nobody_knows_how_much_there_is(log, caplog) -> None:
    clock = Clock()
    lines = Lines(log, clock)
    clock.now = 30.0
    lines("masks", 7, None)
    assert caplog.messages == ["masks: 7"]


def test_a_line_of_somebody_else_counts(log, caplog) -> None:
    clock = Clock()
    lines = Lines(log, clock)
    clock.now = 15.0
    lines.said()
    clock.now = 20.0
    lines("cycle", 5, 10)
    assert caplog.messages == []


def test_a_bar_on_a_terminal(log, caplog) -> None:
    out = io.StringIO()
    console = Console(file=out, force_terminal=True, width=100)
    with Shown(log, console) as shown:
        assert list(counted("abc", shown, "masks", 3)) == ["a", "b", "c"]
        shown("masks.mp4", 1, 2)
    assert "masks" in out.getvalue()
    assert "0/3" in out.getvalue()
    assert "masks.mp4" in out.getvalue()
    assert caplog.messages == []


def test_elsewhere_no_bar(log) -> None:
    out = io.StringIO()
    with Shown(log, Console(file=out)) as shown:
        assert list(counted("abc", shown, "masks", None)) == ["a", "b", "c"]
    assert out.getvalue() == ""
    silent("masks", 1, 2)
