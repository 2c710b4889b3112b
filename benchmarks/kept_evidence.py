"""All evidence of sessions with open labels that is kept here, to ask what a rule of the decision is worth.

It is of several versions of the method. A session that two of them have judged counts twice.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import pandas as pd
from held_corners import TABLE as HELD_CORNERS
from session_ladder import NEVER_LEARNT_FROM
from session_weights import RESULTS, cases_of, of_width, score

from toile.diagnosis.session_settings import SessionSettings
from toile.diagnosis.session_weights import SessionCase, SessionWeights

TODAY = ("held_corners", "session_evidence_held", "session_evidence_finer", "session_evidence_sealed")
"""Tables by a base model as fine as today's; those of a coarser grid leave more to be taken up."""

COLUMNS = ("", *(".3f", "g", "g") * 2)
"""Formats of the columns of ``compared`` with two groups."""


def kept_cases(of_today: bool | None = None) -> list[SessionCase]:
    """Of all tables of evidence.

    Args:
        of_today: only those of TODAY, or only the others.
    """
    held = of_width(pd.read_csv(HELD_CORNERS), SessionSettings().held)
    tables = {HELD_CORNERS.stem: held}
    tables |= {path.stem: pd.read_csv(path) for path in sorted(RESULTS.glob("session_evidence_*.csv"))}
    return [
        replace(case, session=f"{engine} {case.session}")
        for name, table in tables.items()
        if of_today is None or (name in TODAY) == of_today
        for engine, own in table.groupby("engine", sort=False)
        for case in cases_of(own)
    ]


def by_engines(every: Sequence[SessionCase]) -> dict[str, list[SessionCase]]:
    """Cases of engines that teach, and of the one that never does."""
    found: dict[str, list[SessionCase]] = {"own and Blender": [], "MuJoCo": []}
    for case in every:
        never = case.session.startswith(NEVER_LEARNT_FROM)
        found["MuJoCo" if never else "own and Blender"].append(case)
    return found


def compared(
    groups: Mapping[str, Sequence[SessionCase]], setting: str, values: Mapping[str, SessionWeights]
) -> pd.DataFrame:
    """Mean loss, names and wrong names of groups of cases by several weights.

    Args:
        groups: cases by the group's name.
        setting: what the first column is called.
        values: weights for one clip, by what stands in that column.
    """
    return pd.DataFrame(
        {setting: value}
        | {
            key: number
            for group, own in groups.items()
            for key, number in score([(case, weights) for case in own], f", {group}").items()
        }
        for value, weights in values.items()
    )
