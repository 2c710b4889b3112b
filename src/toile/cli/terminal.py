"""Tables on the terminal."""

from __future__ import annotations

import math
import os
import sys
from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table
from rich.text import Text

if TYPE_CHECKING:
    from toile.evaluation.evaluate import EvaluationResult

PIPE_WIDTH = 160
"""Columns where the output is no terminal: enough that tables in a log are not cut."""


class _Output(Console):
    """A console that falls silent, instead of ending the program, when its reader (head, less) has gone."""

    def on_broken_pipe(self) -> None:
        """Send what is still printed to nowhere; the command goes on, and its exit status is its own."""
        self.quiet = True
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def console() -> Console:
    """A console for results, on standard output."""
    probe = _Output()
    return probe if probe.is_terminal else _Output(width=PIPE_WIDTH)


def print_evaluation(result: EvaluationResult) -> None:
    """Print the metrics as a table, and below it how each was measured."""
    title = Text(f"{result.scene}, {result.n_frames} frames, seed {result.seed}")
    table = Table(title=title, title_justify="left")
    for heading in ("metric", "mean", "unit", "worst", "frame"):
        table.add_column(heading, justify="right" if heading in ("mean", "worst", "frame") else "left")
    for metric in result.metrics.values():
        worst = metric.worst_frame
        cells = (
            metric.title,
            _number(metric.mean),
            metric.unit,
            "–" if worst is None else _number(float(metric.per_frame[worst])),
            "–" if worst is None else str(worst),
        )
        table.add_row(*map(Text, cells))
    out = console()
    out.print(table)
    for metric in result.metrics.values():
        named = metric.protocol.lower().startswith(metric.title.lower())
        out.print(Text(metric.protocol if named else f"{metric.title}: {metric.protocol}", style="dim"))
    for key, reason in result.skipped.items():
        out.print(Text(f"{key}: not measured, {reason}", style="dim"))


def _number(value: float) -> str:
    return "–" if math.isnan(value) else f"{value:.4g}"


def print_path(path: object, note: str = "") -> None:
    """Print where something was written, never wrapped, so that it can be copied."""
    console().print(f"{path}{note}", soft_wrap=True, highlight=False, markup=False)
