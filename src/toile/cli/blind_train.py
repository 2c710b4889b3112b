"""``toile blind train``: clips of the fast simulator, their features, the decision grown on them."""

from __future__ import annotations

import csv
import io
import logging
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from omegaconf import DictConfig

from toile.atomic_file import write_text
from toile.cli.configuration import instantiate
from toile.cli.terminal import print_path
from toile.diagnosis.learned.measures import Row, measured, scored, session_probabilities
from toile.diagnosis.learned.training import calibrated, trained
from toile.diagnosis.learned.training_set import TrainingSet, split

SHARES = 0.78, 0.09, 0.13
"""Of the scenes: to grow trees on, to calibrate on, to measure on."""

_log = logging.getLogger(__name__)


def train(cfg: DictConfig) -> None:
    """Make what is missing of the training set, grow and calibrate the trees, measure them.

    Args:
        cfg: the node ``learned`` of blind.yaml.
    """
    training_set: TrainingSet = instantiate(cfg.set)
    training_set = replace(training_set, folder=Path(training_set.folder))
    settings = instantiate(cfg.trees)
    training_set.make(lambda kind, done, total: _log.info("%s: %d of %d chunks", kind, done, total))
    clips, sessions = training_set.read()
    growing, calibrating, held_out = split(clips, SHARES, settings.seed)
    half = len(sessions) // 2
    decision = calibrated(trained(growing, settings), calibrating, sessions[:half])
    weights = Path(cfg.weights)
    decision.save(weights)
    rows = measured(decision, held_out)
    for n in (1, 2, 3) if sessions[half:] else ():
        p = session_probabilities(decision, sessions[half:], n)
        causes = np.array([s.labels[0] for s in sessions[half:]])
        rows += scored(decision, p, causes, f"sessions, {n} clips")
    table = weights.with_suffix(".csv")
    write_text(table, as_csv(rows))
    print_path(weights, f": grown on {len(growing)} clips, measured on {len(held_out)}")
    print_path(table)


def as_csv(rows: list[Row]) -> str:
    """Measures as a table."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("measure", "subset", "value", "low", "high", "n"))
    for row in rows:
        values = ("" if math.isnan(v) else f"{v:.4f}" for v in (row.value, row.low, row.high))
        writer.writerow((row.measure, row.subset, *values, row.n))
    return text.getvalue()
