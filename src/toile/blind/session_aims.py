"""What the project aims at with sessions, and the table of measures held against it."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import pandas as pd

from toile.blind.session_measures import with_intervals

NAMED = "named rightly, effects of 3 % and more"
_FEWEST = 5
"""Sessions below which no interval leaves no doubt: one that is resampled from so few is too narrow."""


@dataclass(frozen=True)
class SessionAim:
    """One aim.

    Attributes:
        measure: row of the table of measures, see session_measures.
        clips: that the answers were made from, as the table has it.
        at_least: lower bound, None for none.
        at_most: upper bound, None for none.
        generator: of the sessions; "all" for all of them.
    """

    measure: str
    clips: str
    at_least: float | None = None
    at_most: float | None = None
    generator: str = "all"

    @property
    def text(self) -> str:
        """For people."""
        if self.at_least is not None and self.at_most is not None:
            return f"{self.at_least:.2f}–{self.at_most:.2f}"
        return f"≥ {self.at_least:.2f}" if self.at_least is not None else f"≤ {self.at_most:g}"

    def holds(self, value: float) -> bool:
        """Whether a value reaches it."""
        return (self.at_least is None or value >= self.at_least) and (
            self.at_most is None or value <= self.at_most
        )

    def sure(self, value: float, low: float, high: float) -> bool:
        """Whether the interval around a value leaves no doubt of what ``holds`` says of it."""
        if self.holds(value):
            return self.holds(low) and self.holds(high)
        below = self.at_least is not None and high < self.at_least
        return below or (self.at_most is not None and low > self.at_most)


def _aims() -> Iterable[SessionAim]:
    for generator, share in (("toile", 0.90), ("blender", 0.75), ("mujoco", 0.75)):
        yield SessionAim(NAMED, "3", share, generator=generator)
    for generator, share in (("toile", 0.50), ("blender", 0.40)):
        yield SessionAim(NAMED, "1", share, generator=generator)
    for clips in ("3", "1"):
        yield SessionAim("false alarms on nulls", clips, at_most=0.02)
        yield SessionAim("90 % set: coverage", clips, 0.90)
    yield SessionAim("90 % set: mean size", "3", at_most=3.0)
    yield SessionAim("90 % set: mean size", "3+1", at_most=1.5)
    for clips in ("3", "1"):
        yield SessionAim("calibration error", clips, at_most=0.03)
        yield SessionAim("outside: abstains", clips, 0.85)
        yield SessionAim("outside: confidently wrong", clips, at_most=0.05)
    yield SessionAim("magnitude: median error", "3", at_most=0.15)
    yield SessionAim("magnitude: interval coverage", "3", 0.85, 0.95)
    yield SessionAim("shrink of the answer, share of the oracle's", "3", 0.85)
    yield SessionAim("best placebo's shrink, share of the oracle's", "3", at_most=0.15)
    yield SessionAim("vertices AUPRC", "3", 0.80)
    yield SessionAim("interval F1", "3", 0.80)
    yield SessionAim("image effects named rightly", "3", 0.95)
    yield SessionAim("time, median [s]", "3", at_most=1800.0)
    yield SessionAim("time, median [s]", "1", at_most=480.0)


SESSION_AIMS = tuple(_aims())


def against_aims(measures: pd.DataFrame) -> pd.DataFrame:
    """Every aim with what was measured: measure, generator, clips, aim, measured, reached, sure.

    ``measured`` is the value with its interval and the number of sessions, a dash where none says anything;
    ``sure`` is whether the whole interval, of five sessions or more, is on the value's side of the aim.

    Args:
        measures: see session_measures.measured_sessions; of one version where sets are put together.
    """
    table = measures.assign(shown=with_intervals(measures))
    table = table.set_index(["measure", "generator", "clips"])
    rows = []
    for aim in SESSION_AIMS:
        place = (aim.measure, aim.generator, aim.clips)
        row = {"measure": aim.measure, "generator": aim.generator, "clips": aim.clips, "aim": aim.text}
        found = table.loc[place] if place in table.index else None
        if found is None or math.isnan(found["value"]):
            rows.append({**row, "measured": "–", "reached": "–", "sure": "–"})
            continue
        value, low, high = (float(found[name]) for name in ("value", "low", "high"))
        reached, sure = aim.holds(value), found["scenes"] >= _FEWEST and aim.sure(value, low, high)
        said = {"reached": "yes" if reached else "no", "sure": "yes" if sure else "no"}
        rows.append({**row, "measured": found["shown"], **said})
    return pd.DataFrame(rows)


def aims_section(measures: pd.DataFrame, title: str = "Against the aims") -> str:
    """The table of ``against_aims`` for people, with its heading."""
    said = (
        f"Reached: by the value; sure: by the whole interval, of {_FEWEST} sessions or more. The oracle is "
        "the true effect, fitted as any other."
    )
    return f"## {title}\n\n{said}\n\n{against_aims(measures).to_markdown(index=False)}"
