"""What passes before the cloth: how much of its print is gone where something does, and where nothing does.

    python benchmarks/occlusion.py
        # from docs/results/occlusion.csv: occlusion.md, and two weights of sessions
    python benchmarks/occlusion.py --sessions unmasked_occluder:6:403 shading:7:407 ...
        # makes and tracks first clips of sessions that session_ladder names, and adds them first
    python benchmarks/occlusion.py --graded NAME=MARKS.csv
        # adds first clips of a graded set, scenes in outputs/blind/NAME

Sessions of the engine that is for sealed sets alone never teach.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from holders import SHARE, parted, ship, updated
from opened_session import opened
from scipy.special import expit
from session_ladder import BLENDER, NEVER_LEARNT_FROM, cause_of, made

from toile.atomic_file import write_text
from toile.cli.configuration import register_resolvers
from toile.denormals import denormals_flushed
from toile.diagnosis.session_diagnosis import hidden_in
from toile.diagnosis.session_weights import SessionWeights
from toile.generation.clip_plan import DEFAULT_CLIPS
from toile.generation.out_of_family.making import size_of
from toile.generation.out_of_family.outside import Occluder

RESULTS = Path("docs") / "results"
TABLE = RESULTS / "occlusion.csv"
KEPT = Path("outputs") / "occlusion"
"""Where clips are tracked."""
HIDDEN = "hidden [%]"
COVERED = Occluder.NAME
"""The effect that passes before the cloth."""


@denormals_flushed()
def hidden(folder: Path) -> float:
    """Share of the print that is hidden at most in the first clip of a session."""
    session = opened(folder, KEPT / folder.name, first=True)
    return float(hidden_in(session.clips[0], session.together.occlusion).max())


def of_ladder(sessions: Sequence[str]) -> list[dict[str, object]]:
    """One row for each of these sessions."""
    rows = []
    for session in sessions:
        folder = made(session, plans=DEFAULT_CLIPS[:1])
        engine = "blender" if session.startswith(BLENDER) else "toile"
        size = float(session.split(":")[1])
        rows.append(_row(folder.name, engine, cause_of(folder.name), size, hidden(folder)))
        print(rows[-1], flush=True)
    return rows


def of_graded(name: str, marks: pd.DataFrame) -> list[dict[str, object]]:
    """One row for every session of a graded set."""
    rows = []
    for mark in marks.drop_duplicates("scene").itertuples():
        seen = hidden(Path("outputs") / "blind" / name / "scenes" / str(mark.scene))
        # Of a null nothing is asked.
        size = float(np.nan_to_num(float(str(mark.asked_percent))))
        rows.append(_row(str(mark.scene), str(mark.generator), str(mark.truth), size, seen))
        print(rows[-1], flush=True)
    return rows


def _row(session: str, engine: str, cause: str, size: float, seen: float) -> dict[str, object]:
    if cause == COVERED:
        # Asked for as an effect on the motion is, made as large by its own levels.
        size = size_of(Occluder, size)
    return {"session": session, "engine": engine, "cause": cause, "size [%]": size, HIDDEN: 100 * seen}


def learnt(table: pd.DataFrame) -> SessionWeights:
    """The two weights under which what is covered and what is not is most probable."""
    found = SessionWeights()
    shares = np.log(np.maximum(table[HIDDEN].to_numpy(np.float64) / 100, 1e-4))
    covered = (table["cause"] == COVERED).to_numpy()
    at, steep = parted(shares, covered, (float(np.log(found.covered)), 1.0), found.covering)
    return replace(found, covered=float(np.exp(at)), covering=steep)


def chance(percent: float, weights: SessionWeights) -> float:
    """Probability that something passes before the cloth."""
    share = max(percent / 100, 1e-4)
    return float(expit(weights.covering * np.log(share / weights.covered)))


def by_others(table: pd.DataFrame) -> pd.DataFrame:
    """The table with the probability by weights that a session had no part in."""
    teaching = table[table["engine"] != NEVER_LEARNT_FROM]
    found = [
        chance(row[HIDDEN], learnt(teaching[teaching["session"] != row["session"]]))
        for row in table.to_dict("records")
    ]
    return table.assign(**{"is covered": found})


def page(table: pd.DataFrame, weights: SessionWeights) -> str:
    """The page."""
    teaching = table[table["engine"] != NEVER_LEARNT_FROM]
    shown = by_others(table).sort_values([HIDDEN, "session"], ascending=[False, True], kind="stable")
    shown = shown.round({"size [%]": 1, HIDDEN: 2, "is covered": 3})
    lines = [
        "# What passes before the cloth",
        "",
        "Made by `python benchmarks/occlusion.py` from `occlusion.csv`: first clips of "
        f"{len(table)} sessions with open labels. The share of the cloth's print that is gone "
        "(diagnosis/occlusion.py) for a while, in the frame in which most is, at the tracked positions. "
        f"Probabilities by weights that the session had no part in; {NEVER_LEARNT_FROM} never teaches. Size: "
        "of an occluder the part of the cloth that it covers, of other effects as they are asked for.",
        "",
        f"Shipped: `covered` {weights.covered:.4f}, `covering` {weights.covering:.2f}, from {len(teaching)} "
        f"sessions, {int((teaching['cause'] == COVERED).sum())} of them with an occluder, where "
        f"{100 * SHARE:g} % are expected.",
        "",
        shown.to_markdown(index=False),
        "",
    ]
    return "\n".join(lines)


def main() -> None:
    """Add sessions to the table, or learn from it."""
    register_resolvers()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--sessions", nargs="+", default=[], help="sessions to add, see session_ladder")
    parser.add_argument("--graded", nargs="+", default=[], help="NAME=MARKS.csv of graded sets to add")
    given = parser.parse_args()
    rows = of_ladder(given.sessions)
    for one in given.graded:
        name, _, marks = str(one).partition("=")
        rows += of_graded(name, pd.read_csv(marks, keep_default_na=False, na_values=[""]))
    table = updated(TABLE, rows)
    teaching = table[table["engine"] != NEVER_LEARNT_FROM]
    weights = learnt(teaching)
    ship(weights, ("covered", "covering"), len(teaching), "docs/results/occlusion.md")
    text = page(table, weights)
    write_text(RESULTS / "occlusion.md", text)
    print(text)


if __name__ == "__main__":
    main()
