"""All sealed sessions so far, and those since corners are held, in one table each.

    make blind-sessions-pooled

Writes docs/results/blind_sessions_pooled.md and .csv, the record, and blind_sessions.md and .csv, a
measurement by the sets in ``LAST``, whose versions differ little. Reads the marks of every graded set
(``docs/results/blind_sessions_*_marks.csv``). Every session was answered blind, each by the version of its
day: sets of few sessions say little one by one, and the versions differ.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from toile.atomic_file import write_text
from toile.blind.session_aims import aims_section
from toile.blind.session_measures import measured_sessions, with_intervals

RESULTS = Path("docs") / "results"
STEM = "blind_sessions_pooled"
LAST_STEM = "blind_sessions"
SUFFIX = "_marks.csv"
SCENE = "1, as a scene"
"""How marks call answers of the method of single clips."""
_SESSIONS = "this method"
EARLIER = ("twelve", "eight", "second_twelve", "second_eight", "four")
"""Sets answered before the motion was refined by the model's errors as they are found, oldest first."""
LAST = (
    "third_short",
    "fifteenth_medium",
    "sixteenth_medium",
    "fifth_effects",
    "seventeenth_medium",
    "sixth_effects",
    "seventh_effects",
    "eighteenth_medium",
    "eighth_effects",
    "nineteenth_medium",
)
"""Sets answered since corners that nobody moved are held; in what they differ: ``last_page``."""
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
    "first_effects",
    "thirteenth_medium",
    "second_effects",
    "third_effects",
    "fourteenth_medium",
    "second_short",
    "fourth_effects",
    *LAST,
)
"""Sets answered since what the catalogue lacks has stand-ins, and contact is a candidate."""
OF_CAUSES = ("second_effects", "third_effects", "fourteenth_medium", "second_short", "fourth_effects", *LAST)
"""Sets whose labels of Blender's scenes name the vertices that an effect acts on. Before they named those
that move, and any map of a drag had 0.8: such marks count no more."""
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
    for path in sorted(folder.glob(f"{LAST_STEM}_*{SUFFIX}")):
        # "null" is a kind of session here.
        own = pd.read_csv(path, keep_default_na=False, na_values=[""])
        name = path.name.removeprefix(f"{LAST_STEM}_").removesuffix(SUFFIX)
        own = own.assign(clips=own["clips"].astype(str))
        if name not in OF_CAUSES and "vertices_auprc" in own:
            own.loc[own["generator"] == "blender", "vertices_auprc"] = np.nan
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


def last(every: pd.DataFrame) -> pd.DataFrame:
    """The measures over the latest sets."""
    own = every[every["set"].isin(LAST) & (every["clips"] != SCENE)]
    return measured_sessions(
        own.sort_values("clips", ascending=False, kind="stable"), resamplings=2000, seed=0
    )


def beside_scenes(every: pd.DataFrame) -> pd.DataFrame:
    """The measures over sessions that the method of single clips has answered too: its answers, and ours.

    Ours are of all the clips of a session, the other method's of its first.
    """
    asked = every.loc[every["clips"] == SCENE, "scene"]
    both = every[every["scene"].isin(asked) & every["clips"].isin((SCENE, "1", "3"))]
    most = both["clips"].map({SCENE: 0, "1": 1, "3": 3})
    ours = most.where(most > 0).groupby(both["scene"]).transform("max")
    both = both[(most == 0) | (most == ours)]
    clips = both["clips"].where(both["clips"] == SCENE, _SESSIONS)
    # The answer that does without any method is the same for both: it stays with ours.
    return measured_sessions(both.assign(clips=clips), resamplings=2000, seed=0)


def _beside(table: pd.DataFrame, n: int) -> str:
    """Of all generators together, method beside method; the largest drop is a method as well."""
    drop = " [largest drop of training loss]"
    rows = table[(table["generator"] == "all") & (table["scenes"] > 0)].copy()
    dropped = rows["measure"].str.endswith(drop)
    rows = rows[(rows["clips"] == _SESSIONS) | ~dropped]
    rows["method"] = (
        rows["clips"]
        .replace({SCENE: "method of single clips"})
        .where(~rows["measure"].str.endswith(drop), "largest drop of the training loss")
    )
    rows["measure"] = rows["measure"].str.removesuffix(drop)
    rows["cell"] = with_intervals(rows)
    wide = rows.pivot(index="measure", columns="method", values="cell").fillna("–")
    order = [name for name in (*MEASURES, "time, median [s]") if name in wide.index]
    columns = list(dict.fromkeys(rows["method"]))
    return (
        f"## Beside the method of single clips, on the same {n} sessions\n\n"
        "Sessions that `as_scene=true` has answered as well: their first clip, as a scene of its own, by the "
        "method of single clips. This one, by the version of its day, had all their clips (mostly one).\n\n"
        + wide.loc[order, columns].to_markdown()
    )


def markdown(table: pd.DataFrame, every: pd.DataFrame) -> str:
    """The page of the record."""
    parts = [_section(rows, f", {version}") for version, rows in table.groupby("version", sort=False)]
    own = every[every["clips"] != SCENE]
    n_scenes = every.loc[every["clips"] == SCENE, "scene"].nunique()
    scenes = [_beside(beside_scenes(every), n_scenes)] if n_scenes else []
    sets = f"{own['set'].nunique()} sets: {_sets(own)}"
    return "\n\n".join(
        (
            "# All sealed sessions so far",
            f"Made by `make blind-sessions-pooled` from the marks of {sets}. Each session was "
            "answered before its label was opened, by the version of its day; versions differ, and each set "
            "has taught those after it, so this is a record and no measurement of one "
            f"method ([the latest]({LAST_STEM}.md)). Value [95 % interval], sessions. With few sessions the "
            "calibration error comes out too large. Maps of Blender's earlier sessions are left out: their "
            "labels named the vertices that move, not those that the cause acts on.",
            aims_section(table[table["version"] == NOW], f"Against the aims, {NOW}"),
            *scenes,
            *parts,
            "",
        )
    )


def last_page(table: pd.DataFrame, every: pd.DataFrame) -> str:
    """The page of the latest sets."""
    own = every[every["set"].isin(LAST) & (every["clips"] != SCENE)]
    return "\n\n".join(
        (
            "# Sealed sessions since corners are held",
            f"Made by `make blind-sessions-pooled` from the marks of {_sets(own)}, every session answered "
            "before its label was opened, by the version that its page names. All are since corners that "
            "nobody moved are held. They differ in six steps: since "
            "[sixteenth medium](blind_sessions_sixteenth_medium.md) nothing blows in a release, since "
            "[seventeenth medium](blind_sessions_seventeenth_medium.md) gusts push harder what faces them, "
            "since three of its sessions an obstacle's push has a history, since "
            "[seventh effects](blind_sessions_seventh_effects.md) what may speak for `none` is bounded, "
            "since [eighth effects](blind_sessions_eighth_effects.md) what has no history needs half as "
            "much, and in [nineteenth medium](blind_sessions_nineteenth_medium.md) motions are refined by "
            "finer modes. "
            "All versions: "
            f"[the record]({STEM}.md). Value [95 % interval], sessions. With few sessions the calibration "
            "error comes out too large.",
            aims_section(table),
            _section(table, ""),
            "",
        )
    )


def _section(table: pd.DataFrame, of: str) -> str:
    """Measures by generator, for every number of clips."""
    shown = table[table["measure"].isin(MEASURES) & (table["scenes"] > 0)].copy()
    shown["cell"] = with_intervals(shown)
    parts = []
    for clips, rows in shown.groupby("clips", sort=False):
        wide = rows.pivot(index="measure", columns="generator", values="cell").fillna("–")
        order = [name for name in MEASURES if name in wide.index]
        columns = list(dict.fromkeys(rows["generator"]))
        parts.append(f"## {_clips(str(clips))}{of}\n\n" + wide.loc[order, columns].to_markdown())
    return "\n\n".join(parts)


def _sets(own: pd.DataFrame) -> str:
    """Sets with their pages and numbers of sessions."""
    counts = own.groupby("set", sort=False)["scene"].nunique()
    return ", ".join(f"{_set(str(name))} ({n})" for name, n in counts.items())


def _clips(number: str) -> str:
    return "One clip" if number == "1" else f"{number} clips"


def _set(name: str) -> str:
    return f"[{name.replace('_', ' ')}]({LAST_STEM}_{name}.md)"


def write(folder: Path = RESULTS) -> tuple[Path, Path]:
    """Write both tables and pages; returns the paths of the pages."""
    every = marks(folder)
    record, measured = pooled(every), last(every)
    texts = {STEM: (record, markdown(record, every)), LAST_STEM: (measured, last_page(measured, every))}
    for stem, (table, _) in texts.items():
        write_text(folder / f"{stem}.csv", table.to_csv(index=False, float_format="%.6g"))
    pages = [write_text(folder / f"{stem}.md", text) for stem, (_, text) in texts.items()]
    return pages[0], pages[1]


if __name__ == "__main__":
    for path in write():
        print(path.read_text())
