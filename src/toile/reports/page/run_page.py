"""The page of one run: opens with the answer, then shows where and when it holds."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
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
from toile.reports.page.document import (
    document,
    figure,
    in_sentence,
    number,
    picture_address,
    section,
    table,
    warning_box,
    with_unit,
)
from toile.reports.page.viewer import Video, viewer

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
        fields = [f for f in (self.error, self.force) if f is not None]
        upright = Upright.of(self.positions[0])
        shown = viewer(
            self.positions,
            self.fps,
            video=self.video,
            shade=self.error,
            ground_truth=self.ground_truth,
            fields=fields,
            upright=upright,
            times=self.times,
        )
        error_title = "Error" if self.error is None else self.error.title
        body = [
            self._answer(),
            shown,
            section(f"{error_title} on the cloth", self._maps(self.error, upright), note=_note(self.error)),
            section(
                "Metrics over time",
                self._errors(),
                note="Click into a chart to go to that frame.",
            ),
            section(
                "Stiffness and forces",
                _parameter_table(self.parameters),
                self._histories(),
                note=escape(self.stiffness_note),
            ),
            section("Forces on the cloth", self._maps(self.force, upright), note=_note(self.force)),
            section("All metrics", self._metric_table(), note=self._metric_note()),
            section("Frames side by side", _pictures(self.pictures)),
            section("How it was made", self._details()),
        ]
        return document(f"{self.scene} – toile", body)

    def _headline(self) -> Metric | None:
        """The metric that answers "how well"."""
        return next(iter(headline_metrics(self.evaluation)), None)

    def _answer(self) -> str:
        F, H, W = self.positions.shape[:3]
        rate = f"{self.fps:g} per second"
        if self.times is not None:
            rate = f"{self.fps:.4g} per second on average"
        what = (
            f"{F} frames ({F / self.fps:.2g} s at {rate}) as a {H} × {W} cloth grid "
            "in metres, from one video."
        )
        metric = self._headline()
        if metric is None:
            lead = f"Reconstructed {what} Nothing is known of the true motion, so no error can be given."
            how = ""
        else:
            against = "" if metric.key == "silhouette_iou" else " against ground truth"
            value = f'<strong class="value">{with_unit(metric.mean, metric.unit)}</strong>'
            lead = f"Reconstructed {what} Mean {in_sentence(metric.title)}{against}: {value}."
            protocol = escape(metric.protocol[:1].upper() + metric.protocol[1:])
            how = f'<p class="protocol"><b>How it was measured.</b> {protocol}.</p>'
        cards = "".join(
            f'<div class="card"><span class="value">{number(m.mean)}'
            f"<small>{' ' + escape(m.unit) if m.unit else ''}</small></span>{escape(m.title)}</div>"
            for m in headline_metrics(self.evaluation)[:MAX_CARDS]
        )
        row = f'<div class="cards">{cards}</div>' if cards else ""
        return (
            '<header><p class="eyebrow">toile · reconstruction of a cloth</p>'
            f"<h1>{escape(self.scene)}</h1>{warning_box(self.warnings)}"
            f'<p class="lead">{lead}</p>{row}{how}</header>'
        )

    def _maps(self, shown: ClothField | None, upright: Upright) -> str:
        if shown is None:
            return ""
        pinned = np.zeros(shown.values.shape[1:], dtype=bool) if self.pinned is None else self.pinned
        chart = field_maps(shown, upright, pinned)
        return figure(chart, f"map-{shown.key}", {"cursors": "1", "field": shown.key})

    def _errors(self) -> str:
        if self.evaluation is None:
            return ""
        metrics = [m for m in self.evaluation.metrics.values() if not math.isnan(m.mean)]
        if not metrics:
            return ""
        panels = [Panel(m.title, m.unit, m.per_frame) for m in metrics]
        frames = np.arange(self.evaluation.n_frames, dtype=np.float64)
        chart = small_multiples(panels, frames, "frame", cursors=True)
        return figure(chart, "errors", {"cursors": str(len(panels))})

    def _metric_note(self) -> str:
        return "" if self.evaluation is None else f"Sampling seed {self.evaluation.seed}."

    def _metric_table(self) -> str:
        if self.evaluation is None:
            return ""
        rows = []
        for m in self.evaluation.metrics.values():
            worst = m.worst_frame
            at = "–" if worst is None else f"{number(float(m.per_frame[worst]))} <i>frame {worst}</i>"
            rows.append(
                f"<tr><th>{escape(m.title)}</th><td>{number(m.mean)}</td>"
                f"<td class='left'>{escape(m.unit)}</td><td data-label='worst'>{at}</td>"
                f"<td class='text'>{escape(m.protocol)}</td></tr>"
            )
        for key, reason in self.evaluation.skipped.items():
            name = key.replace("_", " ")
            name = escape(name[:1].upper() + name[1:])
            rows.append(
                f"<tr class='skipped'><th>{name}</th><td>–</td><td></td><td></td>"
                f"<td class='text'>not measured: {escape(reason)}</td></tr>"
            )
        columns = "<th>metric</th><th>mean</th><th class='left'>unit</th><th>worst</th>"
        return table(f"<tr>{columns}<th class='text'>protocol</th></tr>", rows)

    def _histories(self) -> str:
        if self.history is None or self.history.empty or not self.history_units:
            return ""
        panels, fixed = [], []
        for name, unit in self.history_units.items():
            values = self.history[name].to_numpy(float)
            if np.ptp(values) > 0 or len(values) == 1:
                panels.append(Panel(name, unit, values))
            else:
                fixed.append(f"{escape(name)} = {number(float(values[0]))}")
        note = f'<p class="note">The same in every cycle: {", ".join(fixed)}.</p>' if fixed else ""
        chart = small_multiples(panels, _cycles(self.history), "cycle") if panels else None
        return "<h3>Over the optimisation</h3>" + note + figure(chart, "histories")

    def _losses(self) -> go.Figure | None:
        if self.history is None or self.history.empty or not self.loss_columns:
            return None
        columns = {name: self.history[name].to_numpy(float) for name in self.loss_columns}
        return losses(columns, _cycles(self.history))

    def _details(self) -> str:
        items = "".join(f"<dt>{escape(k)}</dt><dd>{escape(v)}</dd>" for k, v in self.facts.items())
        facts = f"<dl>{items}</dl>" if items else ""
        chart = figure(self._losses(), "losses")
        config = f"<details><summary>Configuration</summary><pre>{escape(self.config)}</pre></details>"
        return facts + chart + (config if self.config else "")


def write_result_page(page: ResultPage, path: Path) -> Path:
    """Write the page as one HTML file; returns ``path``."""
    return write_text(path, page.render())


def headline_metrics(evaluation: EvaluationResult | None) -> list[Metric]:
    """The metrics that say how good a reconstruction is, most telling first."""
    if evaluation is None:
        return []
    found = [evaluation.metrics[k] for k in CARD_METRICS if k in evaluation.metrics]
    return [m for m in found if not math.isnan(m.mean)]


def _note(shown: ClothField | None) -> str:
    if shown is None:
        return ""
    turned = "Seen as the cloth lies in the first frame; circles are pinned vertices."
    return f"{escape(shown.note)} {turned}"


def _pictures(pictures: Sequence[PagePicture]) -> str:
    return "".join(
        f'<div class="strip"><img alt="{escape(p.caption)}" src="{picture_address(p.pixels)}"></div>'
        for p in pictures
    )


def _parameter_table(parameters: Sequence[ReportedParameter]) -> str:
    """One row per name; the same quantity in several units stands side by side."""
    named: dict[str, list[ReportedParameter]] = {}
    for p in parameters:
        named.setdefault(p.name, []).append(p)
    if not named:
        return ""
    columns = max(map(len, named.values()))
    rows = []
    for name, found in named.items():
        cells = []
        for p in found:
            value = escape(p.value) if isinstance(p.value, str) else number(p.value)
            cells.append(f"<td>{value}</td><td class='left'>{escape(p.unit)}</td>")
        cells += ["<td></td><td></td>"] * (columns - len(found))
        note = "; ".join(dict.fromkeys(escape(p.note) for p in found if p.note))
        cells.append(f"<td class='text'>{note}</td>" if any(p.note for p in parameters) else "")
        rows.append(f"<tr><th>{escape(name)}</th>{''.join(cells)}</tr>")
    head = "<th>value</th><th class='left'>unit</th>" + "<th></th><th></th>" * (columns - 1)
    last = "<th class='text'>note</th>" if any(p.note for p in parameters) else ""
    return table(f"<tr><th>parameter</th>{head}{last}</tr>", rows)


def _cycles(history: pd.DataFrame) -> npt.NDArray[np.float64]:
    return history[CYCLE].to_numpy(float) if CYCLE in history else np.arange(len(history), dtype=float)
