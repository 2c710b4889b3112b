"""What a learned decision is worth on clips that it has not seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.special import softmax

from toile.diagnosis.learned.decision import LearnedDecision
from toile.diagnosis.learned.examples import Examples
from toile.generation.fast.effects import NONE, OUTSIDE

Array = NDArray[np.float64]

SIZES = (0.5, 1.5, 3.0, 5.0, 14.0)
"""Bounds of the sizes that are told apart [% of the width]."""


@dataclass(frozen=True)
class Row:
    """One line of a table.

    Attributes:
        measure, subset: what was measured, and on what.
        value: the measure; low and high of its 90 % interval (Wilson), nan where it is no share.
        n: cases.
    """

    measure: str
    subset: str
    value: float
    low: float
    high: float
    n: int


def probabilities(decision: LearnedDecision, examples: Examples) -> Array:
    """Posteriors (n, C)."""
    columns = [examples.names.index(name) for name in decision.names]
    return np.exp(decision.log_posteriors(examples.features[:, columns].astype(np.float64)))


def session_probabilities(decision: LearnedDecision, sessions: Sequence[Examples], clips: int) -> Array:
    """Posteriors (n, C) of sessions, from the first so many clips of each."""
    rows = [np.log(probabilities(decision, s)[:clips]) for s in sessions]
    return np.stack([softmax(decision.combined(r)) for r in rows])


def measured(decision: LearnedDecision, examples: Examples) -> list[Row]:
    """Measures of single clips, by size, noise and frame rate."""
    p = probabilities(decision, examples)
    rows = scored(decision, p, examples.labels, "all")
    effects = ~np.isin(examples.labels, (NONE, OUTSIDE))
    for low, high in pairwise(SIZES):
        part = effects & (examples.sizes >= low) & (examples.sizes < high)
        rows += scored(decision, p[part], examples.labels[part], f"size {low}-{high} %")
    for low, high in ((0.1, 0.3), (0.3, 0.6), (0.6, 1.2)):
        part = (examples.noises >= low) & (examples.noises < high)
        rows += scored(decision, p[part], examples.labels[part], f"noise {low}-{high} %")
    for fps in np.unique(examples.fps):
        part = examples.fps == fps
        rows += scored(decision, p[part], examples.labels[part], f"{fps:g} frames per second")
    for label in decision.labels:
        part = examples.labels == label
        rows += [r for r in scored(decision, p[part], examples.labels[part], label) if r.measure == "right"]
    return rows


def scored(decision: LearnedDecision, p: Array, labels: NDArray[np.str_], subset: str) -> list[Row]:
    """Measures of posteriors (n, C) of cases with these labels."""
    codes = np.array([decision.labels.index(label) for label in labels], int)
    inside = np.array([i for i, label in enumerate(decision.labels) if label not in (NONE, OUTSIDE)])
    effects = np.isin(codes, inside)
    forced = inside[np.argsort(-p[effects][:, inside], axis=1)]
    truth = codes[effects][:, None]
    best = p.argmax(1) if len(p) else np.zeros(0, int)
    none = decision.labels.index(NONE)
    nulls = codes == none
    order = np.argsort(-p, axis=1)
    mass = np.cumsum(np.take_along_axis(p, order, 1), 1)
    sizes = (mass < 0.9).sum(1) + 1
    ranks = (order == codes[:, None]).argmax(1)
    rows = [
        _share("top-1 among effects", subset, (forced[:, :1] == truth).any(1)),
        _share("top-3 among effects", subset, (forced[:, :3] == truth).any(1)),
        _share("right", subset, best == codes),
        _share("nulls called an effect", subset, best[nulls] != none),
        _share("90 % set covers", subset, ranks < sizes),
    ]
    if len(p):
        rows.append(Row("90 % set size", subset, float(sizes.mean()), np.nan, np.nan, len(p)))
        rows.append(Row("calibration error", subset, calibration_error(p, codes), np.nan, np.nan, len(p)))
    return [r for r in rows if r.n]


def calibration_error(p: Array, codes: NDArray[np.int64], bins: int = 10) -> float:
    """Expected error of the highest probability against how often it is right, equally filled bins."""
    best, right = p.max(1), p.argmax(1) == codes
    order = np.argsort(best)
    return float(
        sum(
            abs(best[part].mean() - right[part].mean()) * len(part) / len(p)
            for part in np.array_split(order, bins)
            if len(part)
        )
    )


def _share(measure: str, subset: str, hits: NDArray[np.bool_]) -> Row:
    n = len(hits)
    if not n:
        return Row(measure, subset, np.nan, np.nan, np.nan, 0)
    share, z = float(hits.mean()), 1.645
    middle = (share + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * float(np.sqrt(share * (1 - share) / n + z * z / (4 * n * n)))
    return Row(measure, subset, share, middle - half, middle + half, n)
