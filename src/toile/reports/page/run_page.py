"""The page of one run: opens with the answer, then shows where and when it holds."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pandas as pd
import plotly.graph_objects as go

from toile.atomic_file import write_text
from toile.evaluation.evaluate import EvaluationResult, Metric
from toile.reports.cloth_fields import ClothField, Upright
from toile.reports.figures import CYCLE
from toile.reports.page.charts import Panel, field_maps, losses, small_multiples
from toile.reports.page.document import number, render
from toile.reports.page.viewer import Video, Viewer

CARD_METRICS = (
    "chamfer",
    "vertex_error_percent",
    "point_to_surface",
    "depth_error",
    "normal_error",
    "silhouette_iou",
)
"""Metrics shown large on top, as far as they exist; the first one makes the headline."""
MAX_CARDS = 5


@dataclass(frozen=True)
class ReportedParameter:
    """One fitted or assumed quantity of the report.

    Attributes:
        name: e.g. "stretching stiffness Y".
        value: number, shown with three digits, or text.
        unit: unit of the value, "" where there is none.
        note: how it came about, e.g. "fitted", "assumed, not stated in the data".
    """

    name: str
    value: float | str
    unit: str = ""
    note: str = ""


@dataclass(frozen=True)
class PagePicture:
    """A picture of the report.

    Attributes:
        caption: says what it shows.
        pixels: RGB picture (h, w, 3), uint8.
    """

    caption: str
    pixels: npt.NDArray[np.uint8]


@dataclass(frozen=True)
class ResultPage:
    """What the page of one run shows; parts that are None or empty are left out.

    Attributes:
        scene: name of the scene.
        positions: trajectory (F, H, W, 3) [m], camera frame.
        fps: frames per second, the mean where they are unevenly spaced.
        evaluation: metrics, or None where nothing is known of the truth.
        ground_truth: ground-truth points (N_f, 3) [m], one array per frame.
        error: on the cloth, or what stands in for it; colours the cloth.
        force: on the cloth.
        pinned: pinned vertices (H, W), bool.
        video: pictures of every frame.
        parameters: fitted and assumed quantities.
        history: one row per optimisation cycle.
        history_units: columns of the history to draw as parameters, with their units.
        loss_columns: columns of the history to draw as losses.
        pictures: of a few frames, for print.
        facts: short facts by name, e.g. {"run time": "142 s", "simulator": "implicit"}.
        warnings: of the scene, one sentence each; they stand above everything else.
        stiffness_note: what the stiffness found is worth, as plain text.
        config: resolved configuration as text.
        times: of the frames (F,) [s]; None where they are evenly spaced.
    """

    scene: str
    positions: npt.NDArray[np.floating]
    fps: float
    evaluation: EvaluationResult | None = None
    ground_truth: Sequence[npt.NDArray[np.floating]] | None = None
    error: ClothField | None = None
    force: ClothField | None = None
    pinned: npt.NDArray[np.bool_] | None = None
    video: Video | None = None
    parameters: Sequence[ReportedParameter] = ()
    history: pd.DataFrame | None = None
    history_units: Mapping[str, str] = field(default_factory=dict)
    loss_columns: Sequence[str] = ()
    pictures: Sequence[PagePicture] = ()
    facts: Mapping[str, str] = field(default_factory=dict)
    warnings: Sequence[str] = ()
    stiffness_note: str = ""
    config: str = ""
    times: npt.NDArray[np.floating] | None = None

    def render(self) -> str:
        """The page as HTML text, self-contained."""
        upright = Upright.of(self.positions[0])
        fields = [f for f in (self.error, self.force) if f is not None]
        history, fixed = self._histories()
        headline = headline_metrics(self.evaluation)
        panels = self._metrics()
        frames = np.arange(len(self.positions) if self.evaluation is None else self.evaluation.n_frames)
        return render(
            "run.html.j2",
            page=self,
            headline=next(iter(headline), None),
            cards=[(number(m.mean), m.unit, m.title) for m in headline[:MAX_CARDS]],
            viewer=Viewer.of(
                self.positions,
                self.fps,
                video=self.video,
                shade=self.error,
                ground_truth=self.ground_truth,
                fields=fields,
                upright=upright,
                times=self.times,
            ),
            maps={shown.key: field_maps(shown, upright, self._pinned()) for shown in fields},
            panels=panels,
            metrics=small_multiples(panels, frames.astype(float), "frame", cursors=True) if panels else None,
            parameters=self._parameters(),
            history=history,
            fixed=fixed,
            losses=self._losses(),
        )

    def _pinned(self) -> npt.NDArray[np.bool_]:
        return np.zeros(self.positions.shape[1:3], dtype=bool) if self.pinned is None else self.pinned

    def _metrics(self) -> list[Panel]:
        """Every metric over time."""
        metrics = [] if self.evaluation is None else self.evaluation.metrics.values()
        return [Panel(m.title, m.unit, m.per_frame) for m in metrics if not math.isnan(m.mean)]

    def _parameters(self) -> dict[str, list[ReportedParameter]]:
        """By name: the same quantity in several units stands side by side."""
        named: dict[str, list[ReportedParameter]] = {}
        for p in self.parameters:
            named.setdefault(p.name, []).append(p)
        return named

    def _histories(self) -> tuple[go.Figure | None, dict[str, float]]:
        """Parameters over the optimisation, and those that are the same in every cycle."""
        if self.history is None or self.history.empty:
            return None, {}
        values = {name: self.history[name].to_numpy(float) for name in self.history_units}
        moving = {name: v for name, v in values.items() if np.ptp(v) > 0 or len(v) == 1}
        panels = [Panel(name, self.history_units[name], v) for name, v in moving.items()]
        chart = small_multiples(panels, _cycles(self.history), "cycle") if panels else None
        return chart, {name: float(v[0]) for name, v in values.items() if name not in moving}

    def _losses(self) -> go.Figure | None:
        if self.history is None or self.history.empty or not self.loss_columns:
            return None
        columns = {name: self.history[name].to_numpy(float) for name in self.loss_columns}
        return losses(columns, _cycles(self.history))


def write_result_page(page: ResultPage, path: Path) -> Path:
    """Write the page as one HTML file; returns ``path``."""
    return write_text(path, page.render())


def headline_metrics(evaluation: EvaluationResult | None) -> list[Metric]:
    """The metrics that say how good a reconstruction is, most telling first."""
    if evaluation is None:
        return []
    found = [evaluation.metrics[k] for k in CARD_METRICS if k in evaluation.metrics]
    return [m for m in found if not math.isnan(m.mean)]


def _cycles(history: pd.DataFrame) -> npt.NDArray[np.float64]:
    return history[CYCLE].to_numpy(float) if CYCLE in history else np.arange(len(history), dtype=float)
