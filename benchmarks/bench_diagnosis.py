"""Time of a diagnosis by stage, from the runs of the last blind check (``make blind-results``).

python benchmarks/bench_diagnosis.py

Diagnosing its scenes takes hours, so nothing is measured here: the table comes from the times that every
``toile diagnose`` writes beside its answer, gathered in ``docs/results/blind_standard_times.csv``.
"""

from __future__ import annotations

import platform
from pathlib import Path

import pandas as pd

TIMES = Path(__file__).parent.parent / "docs/results/blind_standard_times.csv"


def table(times: pd.DataFrame) -> pd.DataFrame:
    """Median and range over scenes, one row per scene size and stage, their sum last.

    Args:
        times: one row per scene and stage: ``scene``, ``size``, ``stage``, ``wall`` and ``cpu`` [s], NaN
            where a stage was read back from an interrupted run that left no times.
    """
    # Stages in the order in which they come.
    stages = list(dict.fromkeys(times["stage"]))
    rows = []
    for size, group in times.groupby("size"):
        # Scenes of which every stage is known.
        whole = group.groupby("scene")[["wall", "cpu"]].sum(min_count=1)
        complete = ~group.groupby("scene")["wall"].agg(lambda v: v.isna().any())
        parts = [(stage, group[group["stage"] == stage]) for stage in stages]
        for stage, part in [*parts, ("all", whole[complete.reindex(whole.index)])]:
            known = part.dropna(subset=["wall"])
            if known.empty:
                continue
            cells = {name: _cell(known[name]) for name in ("wall", "cpu")}
            rows.append(
                {
                    "scene": size,
                    "stage": stage,
                    "scenes": len(known),
                    "wall [s]": cells["wall"],
                    "CPU [s]": cells["cpu"],
                }
            )
    return pd.DataFrame(rows, columns=["scene", "stage", "scenes", "wall [s]", "CPU [s]"])


def text(times: pd.DataFrame) -> str:
    """The table with what it says."""
    return (
        f"`toile diagnose` on the scenes of the blind check, {platform.processor() or platform.machine()}, "
        "one thread each; median (smallest – largest) over scenes\n\n"
        + str(table(times).to_markdown(index=False))
    )


def _cell(values: pd.Series) -> str:
    return f"{values.median():.3g} ({values.min():.3g} – {values.max():.3g})"


def main() -> None:
    """See the module."""
    if TIMES.is_file():
        print(text(pd.read_csv(TIMES)))
    else:
        print("No blind check has been graded yet.")


if __name__ == "__main__":
    main()
