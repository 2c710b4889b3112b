"""How far a fit is from the ground truth while it runs: Chamfer distance over the cycles (Fig. 8)."""

from __future__ import annotations

import csv
import math
from pathlib import Path
from typing import Any, final

from lightning import Callback, LightningModule, Trainer
from torch import Tensor

from toile.atomic_file import written_atomically
from toile.evaluation.chamfer import CHAMFER_SCALE, chamfer_distance
from toile.evaluation.target_points import known_frames, target_points
from toile.learning.fit.callbacks.tensorboard import spread_frames
from toile.learning.fit.module import FitModule
from toile.limits import Count, Seed

CHAMFER_TAG = "accuracy/chamfer_x1e4_m2"
"""Of the curve in TensorBoard."""
CYCLE, COVERED, COMPARED, CHAMFER = "cycle", "frames", "frames compared", "chamfer x1e4 [m²]"
"""Columns of the table: frames covered by the fit, frames that were compared, their mean."""


@final
class ChamferLogger(Callback):
    """Evaluates the motion of a cycle against the ground truth, where there is any, and only looks on.

    A fit is bit-identical with and without it, and its time is not time of the fit. The distance is that of
    the final evaluation, but over ``frames`` frames, and over those only that the fit has reached.

    Args:
        file: CSV table, one row per evaluation; a fit that goes on adds to it.
        every: cycles between two evaluations; the last cycle is always evaluated.
        frames: number of frames to compare, evenly spread over the video; None for all.
        seed: of the samples on the surfaces.
    """

    def __init__(self, file: str | Path, every: Count, frames: Count | None, seed: Seed) -> None:
        if every < 1:
            raise ValueError(f"every: expected at least 1 cycle, got {every}")
        self.file = Path(file)
        self.every = every
        self.frames = frames
        self.seed = seed
        self.rows: list[dict[str, float]] = []
        self._targets: dict[int, Tensor] = {}

    @property
    def has_targets(self) -> bool:
        """Whether there is anything to compare with; known once the fit has begun."""
        return bool(self._targets)

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Get the ground truth, and what an interrupted fit has already evaluated."""
        assert isinstance(pl_module, FitModule)
        scene = pl_module.reconstruction.scene
        chosen = list(range(scene.n_frames))
        if self.frames is not None and self.frames < scene.n_frames:
            chosen = spread_frames(scene.n_frames, self.frames)
        chosen = [f for f in chosen if f < known_frames(scene.ground_truth)]
        points, _ = target_points(scene.ground_truth, chosen, self.seed)
        self._targets = dict(zip(chosen, points, strict=True)) if points else {}
        self.rows = [row for row in _read(self.file) if row[CYCLE] < pl_module.cycles_done]

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Evaluate if it is time."""
        assert isinstance(pl_module, FitModule)
        done, report = pl_module.cycles_done, pl_module.report
        if report is None or not (done % self.every == 0 or done == pl_module.n_cycles):
            return
        compared = [f for f in self._targets if f < report.n_frames]
        if not compared:
            return
        faces, motion = pl_module.reconstruction.faces, report.positions.detach()
        mean = math.nan
        if bool(motion.isfinite().all()):
            distances = [
                chamfer_distance(motion[f], faces, self._targets[f], seed=self.seed + f) for f in compared
            ]
            mean = CHAMFER_SCALE * sum(distances) / len(distances)
        self.rows.append({CYCLE: done - 1, COVERED: report.n_frames, COMPARED: len(compared), CHAMFER: mean})
        _write(self.file, self.rows)
        for logger in trainer.loggers:
            logger.log_metrics({CHAMFER_TAG: mean}, step=done - 1)


def _read(file: Path) -> list[dict[str, float]]:
    if not file.is_file():
        return []
    with file.open(newline="", encoding="utf-8") as lines:
        return [{name: float(value) for name, value in row.items()} for row in csv.DictReader(lines)]


def _write(file: Path, rows: list[dict[str, float]]) -> None:
    """Replace the table; there is always a complete one."""
    with written_atomically(file) as temporary, temporary.open("w", newline="", encoding="utf-8") as lines:
        writer = csv.DictWriter(lines, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
