"""One self-contained result page: opens with the answer, needs no network."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import numpy.typing as npt
import pandas as pd
import plotly.graph_objects as go
from plotly.offline import get_plotlyjs
from plotly.subplots import make_subplots

from toile.evaluation.evaluate import EvaluationResult, Metric
from toile.reports.atomic_file import write_text
from toile.reports.figures import CYCLE
from toile.reports.palette import GROUND_TRUTH, INK, MUTED, RECONSTRUCTION, RULE, SERIES
from toile.reports.playback import playback

CARD_METRICS = (
    "chamfer",
    "vertex_error_percent",
    "point_to_surface",
    "depth_error",
    "normal_error",
    "silhouette_iou",
)
"""Metrics shown as cards on top, as far as they exist; the first one makes the headline."""
MAX_CARDS = 5


@dataclass(frozen=True)
class ReportedParameter:
    """One fitted or assumed quantity of the report.

    Attributes:
        name: e.g. "stretching stiffness Y".
        value: number, shown with four digits, or text.
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
        caption: shown below.
        pixels: RGB picture (h, w, 3), uint8.
    """

    caption: str
    pixels: npt.NDArray[np.uint8]


@dataclass(frozen=True)
class ResultPage:
    """What the result page of one run shows; parts that are None or empty are left out.

    Attributes:
        scene: name of the scene.
        positions: trajectory (F, H, W, 3) [m], camera frame.
        fps: frames per second.
        evaluation: metrics, or None where nothing is known of the truth.
        ground_truth: ground-truth points (N_f, 3) [m], one array per frame.
        parameters: fitted and assumed quantities.
        history: one row per optimisation cycle.
        history_units: columns of the history to draw as parameters, with their units.
        loss_columns: columns of the history to draw as losses.
        pictures: overlay pictures and figures.
        facts: short facts by name, e.g. {"run time": "142 s", "simulator": "implicit"}.
        config: resolved configuration as text.
    """

    scene: str
    positions: npt.NDArray[np.floating]
    fps: float
    evaluation: EvaluationResult | None = None
    ground_truth: Sequence[npt.NDArray[np.floating]] | None = None
    parameters: Sequence[ReportedParameter] = ()
    history: pd.DataFrame | None = None
    history_units: Mapping[str, str] = field(default_factory=dict)
    loss_columns: Sequence[str] = ()
    pictures: Sequence[PagePicture] = ()
    facts: Mapping[str, str] = field(default_factory=dict)
    config: str = ""

    def render(self) -> str:
        """The page as HTML text, self-contained."""
        sections = [
            self._answer(),
            _section("Motion in 3D", _embed(self._playback(), "playback"), self._playback_note()),
            _section("Over the video", _pictures(self.pictures)),
            _section("Error per frame", self._errors()),
            _section("All metrics", self._metric_table()),
            _section("Parameters", _parameter_table(self.parameters), _embed(self._histories(), "histories")),
            _section("Optimisation", _embed(self._losses(), "losses")),
            _section("How it was made", self._details()),
        ]
        return PAGE.format(
            title=escape(f"{self.scene} – toile"),
            style=STYLE,
            plotly=get_plotlyjs(),
            body="\n".join(s for s in sections if s),
        )

    def _headline(self) -> Metric | None:
        """The metric that answers "how well"."""
        if self.evaluation is None:
            return None
        found = [self.evaluation.metrics[k] for k in CARD_METRICS if k in self.evaluation.metrics]
        return next((m for m in found if not math.isnan(m.mean)), None)

    def _answer(self) -> str:
        F, H, W = self.positions.shape[:3]
        seconds = F / self.fps
        what = f"{F} frames ({seconds:.2g} s at {self.fps:g} per second) as a {H} × {W} cloth grid"
        metric = self._headline()
        if metric is None:
            lead = f"Reconstructed {what}. Nothing is known of the true motion, so no error can be given."
            how = ""
        else:
            lead = (
                f"Reconstructed {what}. Mean {_lower(metric.title)}: "
                f"<strong>{_number(metric.mean)}{_unit(metric)}</strong>"
            )
            lead += "." if metric.key == "silhouette_iou" else " against ground truth."
            protocol = escape(metric.protocol[:1].upper() + metric.protocol[1:])
            how = f'<p class="protocol"><b>How it was measured.</b> {protocol}.</p>'
        cards = []
        if self.evaluation is not None:
            shown = [self.evaluation.metrics[k] for k in CARD_METRICS if k in self.evaluation.metrics]
            for m in [m for m in shown if not math.isnan(m.mean)][:MAX_CARDS]:
                cards.append(
                    f'<div class="card"><div class="value">{_number(m.mean)}'
                    f"<small>{_unit(m)}</small></div><div>{escape(m.title)}</div></div>"
                )
        row = f'<div class="cards">{"".join(cards)}</div>' if cards else ""
        return f"<header><h1>{escape(self.scene)}</h1><p class='lead'>{lead}</p>{row}{how}</header>"

    def _playback(self) -> go.Figure:
        return playback(self.positions, self.fps, self.ground_truth)

    def _playback_note(self) -> str:
        if self.ground_truth is None:
            return ""
        return (
            '<p class="note">Colour: distance of each vertex to the nearest ground-truth point of its frame. '
            "Dots: a part of the ground-truth points. Drag to turn, scroll to zoom.</p>"
        )

    def _errors(self) -> str:
        if self.evaluation is None:
            return ""
        metrics = [m for m in self.evaluation.metrics.values() if not math.isnan(m.mean)]
        if not metrics:
            return ""
        panels = {m.title: (m.per_frame, m.unit) for m in metrics}
        frames = np.arange(self.evaluation.n_frames, dtype=np.float64)
        return _embed(_small_multiples(panels, frames, "frame"), "errors")

    def _metric_table(self) -> str:
        if self.evaluation is None:
            return ""
        rows = []
        for m in self.evaluation.metrics.values():
            worst = m.worst_frame
            at = "–" if worst is None else f"{_number(float(m.per_frame[worst]))} <i>frame {worst}</i>"
            rows.append(
                f"<tr><th>{escape(m.title)}</th><td>{_number(m.mean)}</td><td>{escape(m.unit)}</td>"
                f"<td>{at}</td><td class='text'>{escape(m.protocol)}</td></tr>"
            )
        for key, reason in self.evaluation.skipped.items():
            rows.append(
                f"<tr class='skipped'><th>{escape(key.replace('_', ' '))}</th><td>–</td><td></td><td></td>"
                f"<td class='text'>not measured: {escape(reason)}</td></tr>"
            )
        head = (
            "<tr><th>metric</th><th>mean</th><th>unit</th><th>worst</th><th class='text'>protocol</th></tr>"
        )
        note = f'<p class="note">Sampling seed {self.evaluation.seed}.</p>'
        return _table(head, rows) + note

    def _histories(self) -> go.Figure | None:
        if self.history is None or self.history.empty or not self.history_units:
            return None
        panels = {
            name: (self.history[name].to_numpy(float), unit) for name, unit in self.history_units.items()
        }
        return _small_multiples(panels, _cycles(self.history), "cycle")

    def _losses(self) -> go.Figure | None:
        if self.history is None or self.history.empty or not self.loss_columns:
            return None
        figure = go.Figure()
        for k, name in enumerate(self.loss_columns):
            line = {"color": SERIES[k % len(SERIES)], "width": 1.8}
            values = self.history[name].to_numpy(float)
            figure.add_scatter(x=_cycles(self.history), y=values, name=name, line=line, mode="lines")
        figure.update_yaxes(type="log", title="loss", exponentformat="power", dtick=1)
        figure.update_xaxes(title="cycle")
        return _plain(figure, 320)

    def _details(self) -> str:
        items = "".join(f"<dt>{escape(k)}</dt><dd>{escape(v)}</dd>" for k, v in self.facts.items())
        facts = f"<dl>{items}</dl>" if items else ""
        text = f"<pre>{escape(self.config)}</pre>"
        config = f"<details><summary>Configuration</summary>{text}</details>" if self.config else ""
        return facts + config


def write_result_page(page: ResultPage, path: Path) -> Path:
    """Write the page as one HTML file; returns ``path``."""
    return write_text(path, page.render())


def _section(title: str, *parts: str) -> str:
    content = "".join(parts)
    return f"<section><h2>{escape(title)}</h2>{content}</section>" if content else ""


def _embed(figure: go.Figure | None, name: str) -> str:
    """A plotly figure as HTML without the library, which the page holds once."""
    if figure is None:
        return ""
    text: str = figure.to_html(
        full_html=False,
        include_plotlyjs=False,
        div_id=name,
        auto_play=False,
        config={"displayModeBar": False, "responsive": True},
    )
    return text


def _pictures(pictures: Sequence[PagePicture]) -> str:
    shown = []
    for picture in pictures:
        buffer = io.BytesIO()
        iio.imwrite(buffer, picture.pixels, extension=".png")
        source = "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")
        caption = escape(picture.caption)
        shown.append(
            f'<figure><img alt="{caption}" src="{source}"><figcaption>{caption}</figcaption></figure>'
        )
    return "".join(shown)


def _parameter_table(parameters: Sequence[ReportedParameter]) -> str:
    if not parameters:
        return ""
    rows = []
    for p in parameters:
        value = escape(p.value) if isinstance(p.value, str) else _number(p.value)
        rows.append(
            f"<tr><th>{escape(p.name)}</th><td>{value}</td><td>{escape(p.unit)}</td>"
            f"<td class='text'>{escape(p.note)}</td></tr>"
        )
    head = "<tr><th>parameter</th><th>value</th><th>unit</th><th class='text'>note</th></tr>"
    return _table(head, rows)


def _table(head: str, rows: Sequence[str]) -> str:
    return f"<div class='scroll'><table><thead>{head}</thead><tbody>{''.join(rows)}</tbody></table></div>"


def _small_multiples(
    panels: Mapping[str, tuple[npt.NDArray[np.float64], str]], x: npt.NDArray[np.floating], x_title: str
) -> go.Figure:
    """One small panel per named series (values, unit), up to three side by side."""
    columns = min(3, len(panels))
    rows = -(-len(panels) // columns)
    height = 215 * rows + 40
    titles = [f"{name} [{unit}]" if unit else name for name, (_, unit) in panels.items()]
    figure = make_subplots(
        rows,
        columns,
        subplot_titles=titles,
        horizontal_spacing=0.07,
        vertical_spacing=min(0.3, 75 / height) if rows > 1 else 0.0,
    )
    for k, (name, (values, unit)) in enumerate(panels.items()):
        row, column = k // columns + 1, k % columns + 1
        colour = SERIES[k % len(SERIES)]
        figure.add_scatter(
            x=x,
            y=values,
            row=row,
            col=column,
            name=name,
            mode="lines",
            line={"color": colour, "width": 1.8},
            showlegend=False,
            hovertemplate=f"{x_title} %{{x}}: %{{y:.4g}} {escape(unit)}<extra></extra>",
        )
        finite = values[np.isfinite(values)]
        # A curve that hardly moves must not look like noise magnified; one from zero keeps proportions
        # honest.
        if finite.size and finite.min() >= 0 and finite.max() > 2 * finite.min():
            figure.update_yaxes(rangemode="tozero", row=row, col=column)
    figure.update_xaxes(title={"text": x_title, "font": {"size": 11}, "standoff": 4})
    figure.update_annotations(font={"size": 12.5, "color": INK})
    return _plain(figure, height)


def _plain(figure: go.Figure, height: int) -> go.Figure:
    figure.update_layout(
        template="none",
        height=height,
        margin={"l": 48, "r": 12, "t": 30, "b": 40},
        font={"color": MUTED, "size": 11, "family": "inherit"},
        paper_bgcolor="white",
        plot_bgcolor="white",
        legend={"font": {"color": INK}},
    )
    figure.update_xaxes(gridcolor=RULE, zeroline=False, linecolor=RULE)
    figure.update_yaxes(gridcolor=RULE, zeroline=False)
    return figure


def _cycles(history: pd.DataFrame) -> npt.NDArray[np.float64]:
    return history[CYCLE].to_numpy(float) if CYCLE in history else np.arange(len(history), dtype=float)


def _number(value: float) -> str:
    """Three or four significant digits, without an exponent where that reads well."""
    if math.isnan(value):
        return "–"
    if value == 0 or 1e-3 <= abs(value) < 1e5:
        digits = max(0, 2 - math.floor(math.log10(abs(value)))) if value else 0
        return f"{value:.{min(digits, 5)}f}"
    mantissa, exponent = f"{value:.2e}".split("e")
    return f"{mantissa}·10<sup>{int(exponent)}</sup>"


def _unit(metric: Metric) -> str:
    return f" {escape(metric.unit)}" if metric.unit else ""


def _lower(title: str) -> str:
    """Lower-case the first letter in the middle of a sentence, but not of an abbreviation or a name."""
    return escape(title if title.startswith("L1") else title[:1].lower() + title[1:])


PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>{style}</style>
<script>{plotly}</script>
</head>
<body>
<main>
{body}
</main>
</body>
</html>
"""

STYLE = f"""
:root {{ color-scheme: light; }}
* {{ box-sizing: border-box; }}
body {{ margin: 0; background: #f5f7fa; color: {INK};
  font: 15px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }}
main {{ max-width: 1120px; margin: 0 auto; padding: 28px 20px 60px; }}
header, section {{ background: white; border: 1px solid {RULE}; border-radius: 12px;
  padding: 22px 26px; margin-bottom: 18px; }}
h1 {{ margin: 0 0 4px; font-size: 30px; letter-spacing: -0.01em; }}
h2 {{ margin: 0 0 12px; font-size: 17px; }}
.lead {{ margin: 0 0 16px; font-size: 17px; max-width: 62em; }}
.lead strong {{ color: {RECONSTRUCTION}; white-space: nowrap; }}
.cards {{ display: flex; flex-wrap: wrap; gap: 12px; margin: 0 0 16px; }}
.card {{ flex: 1 1 150px; border: 1px solid {RULE}; border-top: 3px solid {RECONSTRUCTION}; border-radius:
8px;
  padding: 10px 14px; color: {MUTED}; font-size: 13px; }}
.card .value {{ color: {INK}; font-size: 25px; font-weight: 650; font-variant-numeric: tabular-nums; }}
.card small {{ font-size: 13px; font-weight: 400; color: {MUTED}; margin-left: 2px; }}
.protocol, .note {{ margin: 0; color: {MUTED}; font-size: 13px; }}
.note {{ margin-top: 8px; }}
.scroll {{ overflow-x: auto; }}
table {{ border-collapse: collapse; width: 100%; font-size: 13.5px; font-variant-numeric: tabular-nums; }}
th, td {{ text-align: right; padding: 7px 12px 7px 0; border-bottom: 1px solid {RULE}; vertical-align: top;
  white-space: nowrap; }}
th:first-child {{ text-align: left; font-weight: 600; }}
thead th {{ color: {MUTED}; font-weight: 500; }}
td i {{ color: {MUTED}; font-style: normal; font-size: 12px; }}
.text {{ text-align: left; white-space: normal; min-width: 280px; padding-left: 12px; }}
td.text {{ color: {MUTED}; font-size: 12.5px; line-height: 1.45; }}
tbody tr:last-child > * {{ border-bottom: 0; }}
.skipped th {{ font-weight: 400; color: {MUTED}; }}
figure {{ margin: 0 0 14px; }}
figure:last-child {{ margin: 0; }}
img {{ display: block; max-width: 100%; border-radius: 6px; }}
figcaption {{ color: {MUTED}; font-size: 12.5px; margin-top: 4px; }}
dl {{ display: grid; grid-template-columns: max-content 1fr; gap: 4px 20px; margin: 0 0 12px; font-size:
14px; }} dt {{ color: {MUTED}; }}
dd {{ margin: 0; overflow-wrap: anywhere; }}
summary {{ cursor: pointer; color: {GROUND_TRUTH}; }}
pre {{ background: #f5f7fa; border-radius: 8px; padding: 14px; overflow-x: auto; font-size: 12.5px; }}
@media print {{ body {{ background: white; }} header, section {{ break-inside: avoid; }} }}
"""
