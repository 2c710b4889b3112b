"""Tables of a graded set beside its measures: by generator, by effect, limits, against the baseline."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
import pandas as pd

from toile.blind.measures import Statistic, measured
from toile.diagnosis.record import GapReport
from toile.effects.catalogue import CATALOGUE

LEVELS = ("weak", "medium", "strong")


def by_generator(marks: pd.DataFrame, *, resamplings: int, seed: int) -> pd.DataFrame:
    """The table of measures for the scenes of each generator alone; ``generator`` is the first column."""
    parts = []
    for generator, rows in marks.groupby("generator"):
        table = measured(rows, resamplings=resamplings, seed=seed)
        table.insert(0, "generator", generator)
        parts.append(table)
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame()


def by_effect(marks: pd.DataFrame) -> pd.DataFrame:
    """Single effects: how often each was the answer, in the confidence set, the baseline's answer.

    Columns: effect, scenes, found, rate, in_set, naive (numbers of scenes but for the rate); ``weak``,
    ``medium``, ``strong`` as "found/scenes" and "" where there is none; ``smallest_level`` at which it was
    found, "" for none; ``identifiable`` scenes.
    """
    rows = []
    for name, group in marks[marks["kind"] == "single"].groupby("truth"):
        right = _true(group, "top1")
        levels = {}
        for level in LEVELS:
            at = (group["level"] == level).to_numpy()
            levels[level] = f"{int(right[at].sum())}/{int(at.sum())}" if at.any() else ""
        found_at = [level for level in LEVELS if right[(group["level"] == level).to_numpy()].any()]
        rows.append(
            {
                "effect": name,
                "scenes": len(group),
                "found": int(right.sum()),
                "rate": float(right.mean()),
                **levels,
                "smallest_level": found_at[0] if found_at else "",
                "in_set": int(_true(group, "set_right").sum()),
                "naive": int(_true(group, "naive_top1").sum()),
                "identifiable": int(_true(group, "identifiable").sum()),
            }
        )
    columns = ["effect", "scenes", "found", "rate", *LEVELS, "smallest_level", "in_set", "naive"]
    return pd.DataFrame(rows, columns=[*columns, "identifiable"])


def limits(reports: Iterable[GapReport | None]) -> pd.DataFrame:
    """Detection limits that the diagnosis names, over all clips.

    Columns: effect, parameter and unit that the limit is in, clips that name the effect, of them those with a
    limit within the parameter's bounds, and median, smallest and largest limit of these.
    """
    values: dict[str, list[float | None]] = {}
    for report in reports:
        for name, limit in {} if report is None else report.alias.detection_limits.items():
            values.setdefault(name, []).append(limit)
    rows = []
    for name in CATALOGUE:
        if name not in values:
            continue
        there = [v for v in values[name] if v is not None]
        parameter = CATALOGUE[name].PARAMETERS[0]
        rows.append(
            {
                "effect": name,
                "parameter": parameter.name,
                "unit": parameter.unit,
                "clips": len(values[name]),
                "with_limit": len(there),
                "median": float(np.median(there)) if there else math.nan,
                "smallest": min(there, default=math.nan),
                "largest": max(there, default=math.nan),
            }
        )
    columns = ["effect", "parameter", "unit", "clips", "with_limit", "median", "smallest", "largest"]
    return pd.DataFrame(rows, columns=columns)


def over_naive(marks: pd.DataFrame, *, resamplings: int, seed: int) -> pd.DataFrame:
    """Right answers of the diagnosis minus those of the baseline on the same scenes, with 95 % intervals.

    Columns: over (which scenes), scenes, diagnosis, naive, difference, low, high.
    """
    rng = np.random.default_rng(seed)
    rows = []
    for title, kinds in (("singles", ("single",)), ("singles and nulls", ("single", "null"))):
        chosen = marks[marks["kind"].isin(kinds)]
        if chosen.empty:
            continue
        ours, other = _true(chosen, "top1").astype(float), _true(chosen, "naive_top1").astype(float)
        difference = Statistic("difference")
        compared = chosen.assign(difference=ours - other)
        low, high = difference.interval(compared, resamplings, rng)
        rows.append(
            {
                "over": title,
                "scenes": len(chosen),
                "diagnosis": float(ours.mean()),
                "naive": float(other.mean()),
                "difference": difference(compared),
                "low": low,
                "high": high,
            }
        )
    return pd.DataFrame(rows)


def _true(rows: pd.DataFrame, column: str) -> np.ndarray:
    """Where a mark is true, bool (n,); missing marks are not."""
    if column not in rows.columns:
        return np.zeros(len(rows), bool)
    return np.array([value is not None and value == True for value in rows[column]], bool)  # noqa: E712
