"""All sealed sessions so far in one table: docs/results/blind_sessions_pooled.md and .csv.

    make blind-sessions-pooled

Reads the marks of every graded set (``docs/results/blind_sessions*_marks.csv``). Every session was answered
blind, each by the version of its day: sets of few sessions say little one by one, and the versions differ.
"""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from toile.atomic_file import write_text
from toile.blind.session_aims import aims_section
from toile.blind.session_measures import measured_sessions, with_intervals

RESULTS = Path("docs") / "results"
STEM = "blind_sessions_pooled"
SUFFIX = "_marks.csv"
SCENE = "1, as a scene"
"""How marks call answers of the method of single clips."""
EARLIER = ("twelve", "eight", "second_twelve", "second_eight", "four")
"""Sets answered before the motion was refined by the model's errors as they are found, oldest first."""
LATEST = (
    "outside",
    "medium",
    "second_medium",
    "third_medium",
    "fourth_medium",
    "fifth_medium",
    "sixth_medium",
    "seventh_medium",
    "eighth_medium",
    "ninth_medium",
    "tenth_medium",
    "eleventh_medium",
    "twelfth_medium",
)
"""Sets answered since what the catalogue lacks has stand-ins, and contact is a candidate."""
MEASURES = (
    "named rightly, effects of 3 % and more",
    "named rightly, all effects that move",
    "false alarms on nulls",
    "90 % set: coverage",
    "90 % set: mean size",
    "outside: abstains",
    "outside: confidently wrong",
    "pairs: one right, none wrong",
    "magnitude: median error",
    "magnitude: interval coverage",
    "image effects named rightly",
    "calibration error",
    "named rightly, effects of 3 % and more [largest drop of training loss]",
    "false alarms on nulls [largest drop of training loss]",
)
NOW, SINCE, BEFORE = (
    "since what the catalogue lacks has stand-ins",
    "since the motion is refined by found errors",
    "before",
)


def marks(folder: Path = RESULTS) -> pd.DataFrame:
    """Marks of all sets, with the set and which version answered it.

    Raises:
        ValueError: a session was answered in two sets.
    """
    found = []
    for path in sorted(folder.glob(f"blind_sessions*{SUFFIX}")):
        # "null" is a kind of session here.
        own = pd.read_csv(path, keep_default_na=False, na_values=[""])
        name = path.name.removeprefix("blind_sessions").removesuffix(SUFFIX).lstrip("_")
        own = own.assign(clips=own["clips"].astype(str))
        version = BEFORE if name in EARLIER else NOW if name in LATEST else SINCE
        found.append(own.assign(set=name, version=version))
    together = pd.concat(found, ignore_index=True)
    twice = together[together.duplicated(["scene", "clips"])]
    if len(twice):
        raise ValueError(f"marks: expected every session once, got {', '.join(twice['scene'])} again")
    return together


def pooled(every: pd.DataFrame) -> pd.DataFrame:
    """The measures over the sets of every version; answers of the method of sessions alone."""
    own = every[every["clips"] != SCENE]
    tables = []
    for version in (NOW, SINCE, BEFORE):
        of_version = own[own["version"] == version]
        if of_version.empty:
            continue
        rows = of_version.sort_values("clips", ascending=False, kind="stable")
        measured = measured_sessions(rows, resamplings=2000, seed=0)
        tables.append(measured.assign(version=version))
    return pd.concat(tables, ignore_index=True)


def markdown(table: pd.DataFrame, every: pd.DataFrame) -> str:
    """The page."""
    shown = table[table["measure"].isin(MEASURES) & (table["scenes"] > 0)].copy()
    shown["cell"] = with_intervals(shown)
    parts = []
    for (version, clips), rows in shown.groupby(["version", "clips"], sort=False):
        wide = rows.pivot(index="measure", columns="generator", values="cell").fillna("–")
        order = [name for name in MEASURES if name in wide.index]
        title = f"## {_clips(str(clips))}, {version}"
        parts.append(f"{title}\n\n" + wide.loc[order, list(dict.fromkeys(rows["generator"]))].to_markdown())
    own = every[every["clips"] != SCENE]
    counts = own.groupby("set", sort=False)["scene"].nunique()
    sets = ", ".join(f"{_set(str(name))} ({n})" for name, n in counts.items())
    return "\n\n".join(
        (
            "# All sealed sessions so far",
            f"Made by `make blind-sessions-pooled` from the marks of {counts.size} sets: {sets}. Each "
            "session was answered before its label was opened, by the version of its day; versions differ, "
            "and each set has taught those after it, so this is a record and no measurement of one method. "
            "Value [95 % interval], sessions. With few sessions the calibration error comes out too large.",
            aims_section(table[table["version"] == NOW], f"Against the aims, {NOW}"),
            *parts,
            "",
        )
    )


def _clips(number: str) -> str:
    return "One clip" if number == "1" else f"{number} clips"


def _set(name: str) -> str:
    stem = f"blind_sessions_{name}" if name else "blind_sessions"
    return f"[{name.replace('_', ' ') or 'the last'}]({stem}.md)"


def write(folder: Path = RESULTS) -> Path:
    """Write the table and the page, and return the path of that."""
    every = marks(folder)
    table = pooled(every)
    write_text(folder / f"{STEM}.csv", table.to_csv(index=False, float_format="%.6g"))
    return write_text(folder / f"{STEM}.md", markdown(table, every))


if __name__ == "__main__":
    print(write().read_text())
