"""The card's tables, made from the measurements."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
import pandas as pd

from surrogate.accuracy import ACCELERATION, BALANCE, LAST, MOTION
from surrogate.contenders import FLOOR, SOLVER
from surrogate.stability import REST, WINDOW

# Edges of the bins, in network units at the effective step; the last one is included.
BINS: dict[str, dict[str, tuple[float, ...]]] = {
    "fits": {
        "Y": (222, 471, 1112),
        "S": (0.222, 1.11, 5.56),
        "B": (0.0222, 0.111, 0.556),
        "gravity": (0.02, 0.03, 0.05),
    },
    "box": {
        "Y": (10, 100, 1e3, 1e4),
        "S": (0.01, 0.1, 1, 10),
        "B": (0.001, 0.01, 0.1, 1, 10),
        "gravity": (0.001, 0.01, 0.1, 0.7),
    },
}
WANTED = {0.5: 1.0, 0.95: 5.0}
"""Largest vertex errors [% of width] that the median and the 95th percentile may have."""


def quantile(values: Sequence[float], share: float) -> float:
    """Linear between neighbours, as NumPy's and pandas' are; what is not finite counts as infinite."""
    if not len(values):
        return math.nan
    ordered = np.sort([v if math.isfinite(v) else math.inf for v in values])
    # NumPy's own is not a number beside what is infinite.
    place = share * (len(ordered) - 1)
    below, above = ordered[math.floor(place)], ordered[math.ceil(place)]
    return float(above if math.isinf(above) else below + (place % 1) * (above - below))


def number(value: float) -> str:
    """Three digits; a dash where there is none."""
    if math.isnan(value):
        return "–"
    if math.isinf(value):
        return "∞"
    if value and not 1e-3 <= abs(value) < 1e5:
        return f"{value:.1e}"
    return f"{value:.3g}" if abs(value) < 100 else f"{value:.0f}"


def spread(values: Sequence[float]) -> str:
    """Median / 95th percentile / worst."""
    return " / ".join(number(quantile(values, share)) for share in (0.5, 0.95, 1.0))


def frame(table: pd.DataFrame) -> str:
    """A table in Markdown."""
    return str(table.to_markdown(index=False, disable_numparse=True))


def failures(table: pd.DataFrame) -> str:
    """How many cloths there are, and how many of them even the solver gives up."""
    solver = table[table.contender == SOLVER]
    failed = int(solver.failure.notna().sum())
    return f"{len(solver)} cloths; the solver converged in every step of {len(solver) - failed} of them."


def usable(table: pd.DataFrame) -> pd.DataFrame:
    """Without the comparisons of the solver with itself that failed: they say nothing about anyone."""
    return table[(table.contender != FLOOR) | table.failure.isna()]


def accuracy_summary(table: pd.DataFrame) -> str:
    """One row per contender, over the cloths whose solver converged."""
    rows = []
    for name, part in _contenders(table):
        rows.append(
            {
                "": name,
                ACCELERATION: spread(part[ACCELERATION]) if part[ACCELERATION].notna().any() else "",
                BALANCE: spread(part[BALANCE]) if part[BALANCE].notna().any() else "",
                MOTION: spread(part[MOTION]),
                LAST: spread(part[LAST]),
                "not finite": int((part.failure == "not finite").sum()),
            }
        )
    return frame(pd.DataFrame(rows))


def breakdown(table: pd.DataFrame, regime: str, shown: Sequence[str]) -> str:
    """Vertex error by ranges of each number, for some contenders."""
    rows: list[dict[str, object]] = []
    for name, edges in BINS[regime].items():
        for low, high in itertools.pairwise(edges):
            last = high == edges[-1]
            inside = (table[name] >= low) & (table[name] <= high if last else table[name] < high)
            rows.append(_slice({name: f"{low:g} – {high:g}"}, table[inside], shown))
    return frame(pd.DataFrame(rows))


def corner_table(table: pd.DataFrame, shown: Sequence[str]) -> str:
    """Vertex error of every corner of the box and every gravity."""
    converged = table[table.contender == SOLVER]
    rows = []
    for case in converged.itertuples():
        part = table[table.seed == case.seed].set_index("contender")
        row: dict[str, object] = {n: f"{getattr(case, n):g}" for n in ("Y", "S", "B", "gravity")}
        failed = isinstance(case.failure, str)
        for name in shown:
            row[name] = "" if failed or name not in part.index else number(part.loc[name, MOTION])
        row[SOLVER] = "gives up" if failed else "converges"
        rows.append(row)
    return frame(pd.DataFrame(rows))


def verdict(table: pd.DataFrame, name: str) -> str:
    """The target and what is reached."""
    errors = table[table.contender == name][MOTION]
    words = []
    for share, limit in WANTED.items():
        got = quantile(errors, share)
        what = "median" if share == 0.5 else "95th percentile"
        words.append(f"{what} {number(got)} % ({'meets' if got <= limit else 'misses'} {limit:g} %)")
    return f"{name}: {', '.join(words)}"


def stability_summary(table: pd.DataFrame, solver: pd.DataFrame | None) -> str:
    """One row per contender and material."""
    rows: list[dict[str, object]] = []
    common = int(solver.step.max()) if solver is not None else 0
    for (name, y, s, b), part in table.groupby(["contender", "Y", "S", "B"], sort=False):
        finite = bool(np.isfinite(part[["energy", "speed"]]).all(axis=None))
        end = _fastest(part, int(part.step.max()))
        row: dict[str, object] = {"": name, "Y": f"{y:g}", "S": f"{s:.2g}", "B": f"{b:.2g}"}
        row |= {"finite": "yes" if finite else "**no**", "largest energy above start": number(_largest(part))}
        if solver is not None:
            its = solver[np.isclose(solver.Y, y) & np.isclose(solver.S, s) & np.isclose(solver.B, b)]
            reached = int(its.step.max())
            row[f"speed, step {common}"] = number(_fastest(part, common))
            answer = _fastest(its, common) if reached == common else math.nan
            row[f"solver's speed, step {common}"] = (
                number(answer) if reached == common else f"– ({its.end.iloc[0]}, step {reached})"
            )
        row |= {"speed at the end": number(end), "at rest": "yes" if end < REST else "no"}
        rows.append(row)
    return frame(pd.DataFrame(rows))


def stability_counts(table: pd.DataFrame) -> str:
    """One row per contender: how many materials stay finite, gain energy, come to rest."""
    rows = []
    for name, part in table.groupby("contender", sort=False):
        motions = [m for _, m in part.groupby(["Y", "S", "B"])]
        steps = int(part.step.max())
        rows.append(
            {
                "": name,
                "materials": len(motions),
                "steps": steps,
                "finite": sum(bool(np.isfinite(m[["energy", "speed"]]).all(axis=None)) for m in motions),
                "largest energy above start": number(_largest(part)),
                "at rest": sum(_fastest(m, steps) < REST for m in motions),
                "largest speed at the end": number(max(_fastest(m, steps) for m in motions)),
            }
        )
    return frame(pd.DataFrame(rows))


def gradient_table(table: pd.DataFrame) -> str:
    """Cosine and ratio of norms, worst and all of the seeds."""
    rows = []
    groups = [g for g in table.group.dropna().unique()]
    for name, part in table.groupby("contender", sort=False):
        row: dict[str, object] = {"": name}
        for group in groups:
            its = part[part.group == group]
            row[group] = "; ".join(
                f"{c:.3f} (×{number(r)})" for c, r in zip(its.cosine, its.ratio, strict=True)
            )
        once = part.drop_duplicates("seed")
        errors = once["vertex error [% of width]"]
        row["vertex error [% of width]"] = "; ".join(number(e) for e in errors)
        row["saddles"] = "; ".join(number(n) for n in once.saddles)
        rows.append(row)
    return frame(pd.DataFrame(rows))


def speed_table(table: pd.DataFrame) -> str:
    """Milliseconds per step and cloth's share of a batch, with the ratio to the solver."""
    rows = []
    for name, part in table.groupby("contender", sort=False):
        row: dict[str, object] = {"": name}
        for its in part.to_dict("records"):
            title = f"batch {its['batch']}" + (", linearised" if its["linearize"] else "")
            row[title] = f"{its['ms per step']:.1f} (×{its['solver / this']:.2g})"
        rows.append(row)
    return frame(pd.DataFrame(rows))


def _contenders(table: pd.DataFrame) -> list[tuple[str, pd.DataFrame]]:
    """In the order in which they were measured, the network first and what no network can beat last."""
    measured = table[table.contender != SOLVER]
    names = list(dict.fromkeys(measured.contender))
    ordered = names[1:] + names[:1]
    return [(name, measured[measured.contender == name]) for name in ordered]


def _slice(row: dict[str, object], table: pd.DataFrame, shown: Sequence[str]) -> dict[str, object]:
    ((name, span),) = row.items()
    solver = table[table.contender == SOLVER]
    result: dict[str, object] = {"": name, "range": span, "cloths": int(solver.failure.isna().sum())}
    for contender in shown:
        errors = table[table.contender == contender][MOTION]
        result[contender] = spread(errors) if len(errors) else ""
    return result


def _largest(motion: pd.DataFrame) -> float:
    """Largest energy above the start after the start."""
    return float(motion[motion.step > 0]["largest energy"].max())


def _fastest(motion: pd.DataFrame, until: int) -> float:
    """Largest speed in the window before a step."""
    inside = motion[(motion.step > until - WINDOW) & (motion.step <= until)]
    return float(inside.speed.max(skipna=False)) if len(inside) else math.nan
