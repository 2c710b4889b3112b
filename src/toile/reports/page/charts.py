"""Plotly charts in the style of the pages."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
import numpy.typing as npt
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from toile.reports.cloth_fields import ClothField, Upright
from toile.reports.palette import FONT, INK, MUTED, RULE, SERIES

CURSOR = {"type": "line", "line": {"color": INK, "width": 1}, "x0": 0, "x1": 0, "y0": 0, "y1": 1}
"""A line that viewer.js keeps at the current frame."""
SMALL: dict[str, Any] = {"font": {"size": 11}, "standoff": 4}
"""Titles of axes."""
PANEL_HEIGHT = 215
MAP_HEIGHT = 370
NARROW_MAPS_HEIGHT = 560
ROW_HEIGHT = 30
LINE_HEIGHT = 16
LABEL_WIDTH = 46
"""Characters in a line of a label."""


@dataclass(frozen=True)
class Panel:
    """A curve of its own small chart.

    Attributes:
        title: above it.
        unit: of the values.
        values: (n,); NaN where there is none.
    """

    title: str
    unit: str
    values: npt.NDArray[np.float64]


def small_multiples(
    panels: Sequence[Panel], x: npt.NDArray[np.floating], x_title: str, *, cursors: bool = False
) -> go.Figure:
    """One small chart per panel, up to three side by side; below each other on a narrow screen.

    Args:
        panels: at least one.
        x: shared (n,).
        x_title: label of the x axes.
        cursors: draw a line in each chart for the current frame.
    """
    figure = _small_multiples(panels, x, x_title, min(3, len(panels)), cursors=cursors)
    return with_narrow(figure, _small_multiples(panels, x, x_title, 1, cursors=cursors))


def _small_multiples(
    panels: Sequence[Panel], x: npt.NDArray[np.floating], x_title: str, columns: int, *, cursors: bool
) -> go.Figure:
    rows = -(-len(panels) // columns)
    height = PANEL_HEIGHT * rows + 40
    figure = make_subplots(
        rows,
        columns,
        subplot_titles=[_titled(p.title, p.unit) for p in panels],
        horizontal_spacing=0.07,
        vertical_spacing=min(0.3, 80 / height) if rows > 1 else 0.0,
    )
    for k, panel in enumerate(panels):
        at = {"row": k // columns + 1, "col": k % columns + 1}
        figure.add_scatter(
            x=x,
            y=panel.values,
            mode="lines+markers" if len(x) == 1 else "lines",
            line={"color": SERIES[0], "width": 1.8},
            showlegend=False,
            hovertemplate=f"{x_title} %{{x}}: %{{y:.4g}} {escape(panel.unit)}<extra></extra>",
            **at,
        )
        finite = panel.values[np.isfinite(panel.values)]
        # A curve that hardly moves must not look like noise magnified; one from zero keeps proportions
        # honest.
        if finite.size and finite.min() >= 0 and finite.max() >= 2 * finite.min():
            # Of zeros alone: no axis to below what cannot be.
            figure.update_yaxes(rangemode="tozero" if finite.max() > 0 else "nonnegative", **at)
        if cursors:
            number = "" if k == 0 else str(k + 1)
            figure.add_shape(**CURSOR, xref=f"x{number}", yref=f"y{number} domain")
    figure.update_xaxes(title={"text": x_title, **SMALL})
    return plain(figure, height)


def losses(columns: Mapping[str, npt.NDArray[np.float64]], cycles: npt.NDArray[np.float64]) -> go.Figure:
    """Losses over the optimisation cycles on a logarithmic axis."""
    figure = go.Figure()
    for k, (name, values) in enumerate(columns.items()):
        line = {"color": SERIES[k % len(SERIES)], "width": 1.8}
        # A term that is switched off is zero, which a logarithmic axis cannot show.
        shown = np.where(values > 0, values, np.nan)
        figure.add_scatter(x=cycles, y=shown, name=name, line=line, mode="lines", showlegend=True)
    figure.update_yaxes(type="log", title={"text": "loss", **SMALL}, exponentformat="power", dtick=1)
    figure.update_xaxes(title={"text": "cycle", **SMALL})
    figure.update_layout(legend={"orientation": "h", "y": 1.02, "yanchor": "bottom", "x": 0})
    return _taller_where_narrow(plain(figure, 300), len(columns))


def field_maps(field: ClothField, upright: Upright, pinned: npt.NDArray[np.bool_]) -> go.Figure:
    """Three maps: mean over time on the cloth, the current frame on the cloth, rows of the cloth over time.

    On a narrow screen the third stands below the others.

    Args:
        field: values (F, H, W).
        upright: how the cloth lies in the image.
        pinned: (H, W), marked in the maps of the cloth.
    """
    return with_narrow(_field_maps(field, upright, pinned), _field_maps(field, upright, pinned, narrow=True))


def _field_maps(
    field: ClothField, upright: Upright, pinned: npt.NDArray[np.bool_], *, narrow: bool = False
) -> go.Figure:
    values = upright(field.values)
    frame = len(values) // 2
    mean, over_time = _mean(values, 0), _mean(values, 2).T
    titles = ["mean over time", f"frame {frame}", "rows of the cloth over time"]
    at = [(1, 1), (1, 2), (2, 1) if narrow else (1, 3)]
    if narrow:
        figure = make_subplots(
            2,
            2,
            specs=[[{}, {}], [{"colspan": 2}, None]],
            horizontal_spacing=0.06,
            vertical_spacing=0.1,
            row_heights=[0.4, 0.6],
            subplot_titles=titles,
        )
    else:
        figure = make_subplots(
            1, 3, column_widths=[0.29, 0.29, 0.42], horizontal_spacing=0.045, subplot_titles=titles
        )
    unit = f" {field.unit}"
    on_cloth, in_time = "row %{y}, column %{x}", "frame %{x}, row %{y}"
    for k, (z, where) in enumerate(((mean, on_cloth), (values[frame], on_cloth), (over_time, in_time))):
        figure.add_heatmap(
            z=z.astype(np.float32),
            coloraxis="coloraxis",
            hovertemplate=f"{where}: %{{z:.3g}}{unit}<extra></extra>",
            row=at[k][0],
            col=at[k][1],
        )
    rows, columns = np.nonzero(upright(pinned))
    for k in (1, 2):
        figure.add_scatter(
            x=columns,
            y=rows,
            mode="markers",
            marker={"symbol": "circle-open", "size": 8, "color": INK, "line": {"width": 1.5}},
            hovertemplate="pinned<extra></extra>",
            showlegend=False,
            cliponaxis=False,
            row=1,
            col=k,
        )
        bare = {"constrain": "domain", "showticklabels": False, "ticks": "", "showgrid": False}
        axis = "" if k == 1 else str(k)
        width, height = mean.shape[1] - 0.5, mean.shape[0] - 0.5
        figure.update_xaxes(
            range=[-0.5, width], scaleanchor=f"y{axis}", constraintoward="left", **bare, row=1, col=k
        )
        figure.update_yaxes(range=[height, -0.5], constraintoward="top", **bare, row=1, col=k)
    last = {"row": at[2][0], "col": at[2][1]}
    figure.update_xaxes(title={"text": "frame", **SMALL}, **last)
    figure.update_yaxes(autorange="reversed", title={"text": "row, from the top", **SMALL}, **last)
    figure.add_shape(**CURSOR, xref="x3", yref="y3 domain")
    bar: dict[str, Any] = {"title": {"text": escape(field.unit)}, "thickness": 12, "outlinewidth": 0}
    bar["len"] = 1.0
    if narrow:
        bar |= {"orientation": "h", "y": -0.12, "yanchor": "top", "x": 0.5, "len": 0.8}
        bar["title"]["side"] = "top"
    figure.update_layout(
        coloraxis={
            "colorscale": [list(stop) for stop in field.scale],
            "cmin": 0.0,
            "cmax": field.limit,
            "colorbar": bar,
        }
    )
    plain(figure, NARROW_MAPS_HEIGHT if narrow else MAP_HEIGHT)
    figure.update_layout(margin={"l": 46, "r": 4, "b": 96} if narrow else {"l": 4})
    return figure


@dataclass(frozen=True)
class DotPanel:
    """One quantity of several groups of runs.

    Attributes:
        title: above it.
        unit: of the values.
        values: for each group the value of every run.
    """

    title: str
    unit: str
    values: Sequence[Sequence[float]]


MAX_LINEAR_RANGE = 30.0
"""Ratio of the largest value to the smallest from which on an axis of dots is logarithmic."""


def dots(groups: Sequence[str], names: Sequence[Sequence[str]], panels: Sequence[DotPanel]) -> go.Figure:
    """Groups below each other; in every panel a dot per run and a bar at the group's mean.

    On a narrow screen the panels stand below each other, with every group's label above its dots.

    Args:
        groups: labels, from top to bottom; long ones take several lines.
        names: for each group the names of its runs, shown when pointed at.
        panels: side by side, with shared rows.
    """
    return with_narrow(_dots(groups, names, panels), _dots(groups, names, panels, narrow=True))


def _dots(
    groups: Sequence[str], names: Sequence[Sequence[str]], panels: Sequence[DotPanel], *, narrow: bool = False
) -> go.Figure:
    n, lines = len(groups), max(map(_lines, groups), default=1)
    row_height = LINE_HEIGHT * lines + (20 if narrow else ROW_HEIGHT - LINE_HEIGHT)
    frame = 90 if narrow else 0  # of every panel: title, ticks, unit
    height = (row_height * n + frame) * (len(panels) if narrow else 1) + (0 if narrow else 90)
    figure = make_subplots(
        len(panels) if narrow else 1,
        1 if narrow else len(panels),
        shared_yaxes=not narrow,
        horizontal_spacing=0.04,
        vertical_spacing=min(0.5, frame / height) if narrow and len(panels) > 1 else 0.0,
        subplot_titles=[escape(p.title) for p in panels],
    )
    for k, panel in enumerate(panels, start=1):
        at = {"row": k if narrow else 1, "col": 1 if narrow else k}
        figure.update_xaxes(title={"text": escape(panel.unit), **SMALL}, **_dot_axis(panel), **at)
        for row, values in enumerate(panel.values):
            colour = SERIES[row % len(SERIES)]
            hover = f"%{{text}}: %{{x:.4g}} {escape(panel.unit)}<extra></extra>"
            figure.add_scatter(
                x=list(values),
                y=[row] * len(values),
                text=[escape(name) for name in names[row]],
                mode="markers",
                marker={"color": colour, "size": 9, "opacity": 0.75, "line": {"color": "white", "width": 1}},
                hovertemplate=hover,
                showlegend=False,
                **at,
            )
            finite = [v for v in values if np.isfinite(v)]
            if len(finite) > 1:
                mean = float(np.mean(finite))
                figure.add_scatter(
                    x=[mean, mean],
                    y=[row - 0.3, row + 0.3],
                    mode="lines",
                    line={"color": colour, "width": 2.5},
                    hovertemplate=f"mean: %{{x:.4g}} {escape(panel.unit)}<extra></extra>",
                    showlegend=False,
                    **at,
                )
    figure.update_xaxes(rangemode="normal", exponentformat="power")
    labels = [wrapped(label) for label in groups]
    if narrow:
        figure.update_yaxes(range=[n - 0.6, -1], showticklabels=False, ticks="")
        plain(figure, height)
        for k in range(len(panels)):
            number = "" if k == 0 else str(k + 1)
            for row, label in enumerate(labels):
                figure.add_annotation(
                    x=0, xref=f"x{number} domain", xanchor="left", y=row, yref=f"y{number}", yanchor="bottom",
                    yshift=7, text=label, align="left", showarrow=False, font={"size": 12, "color": INK},
                )  # fmt: skip
        figure.update_layout(margin={"l": 6, "r": 10})
        return figure
    figure.update_yaxes(range=[n - 0.4, -0.6], tickmode="array", tickvals=list(range(n)))
    figure.update_yaxes(ticktext=labels, tickfont={"size": 12, "color": INK}, automargin=True, col=1)
    return plain(figure, height)


def _dot_axis(panel: DotPanel) -> dict[str, Any]:
    """The x axis of a panel: logarithmic over decades, and readable where all runs have the same value."""
    if _spans_decades(panel):
        return {"type": "log", "dtick": 1}
    known = [v for values in panel.values for v in values if np.isfinite(v)]
    if known and max(known) - min(known) <= 1e-9 * max(map(abs, known)):
        # Plotly would show 1 to either side, where a small value cannot be told from zero.
        value = float(np.mean(known))
        reach = 0.1 * abs(value) or 1.0
        return {"range": [value - reach, value + reach], "tickvals": [value], "ticktext": [f"{value:.4g}"]}
    return {"nticks": 5}


def _spans_decades(panel: DotPanel) -> bool:
    """Whether small values could not be told apart on a linear axis."""
    known = [v for values in panel.values for v in values if np.isfinite(v)]
    return bool(known) and min(known) > 0 and max(known) > MAX_LINEAR_RANGE * min(known)


@dataclass(frozen=True)
class Curve:
    """One run's curve.

    Attributes:
        name: of the run.
        group: runs of one group share a colour and a legend entry.
        values: (F,).
    """

    name: str
    group: int
    values: npt.NDArray[np.float64]


def overlaid(curves: Sequence[Curve], groups: Sequence[str], x_title: str, y_title: str) -> go.Figure:
    """Curves of several runs in one chart, coloured by group."""
    figure = go.Figure()
    named: set[int] = set()
    for curve in curves:
        figure.add_scatter(
            x=np.arange(len(curve.values)),
            y=curve.values,
            mode="lines",
            name=wrapped(groups[curve.group]),
            legendgroup=str(curve.group),
            showlegend=curve.group not in named and len(groups) > 1,
            line={"color": SERIES[curve.group % len(SERIES)], "width": 1.5},
            opacity=0.85,
            hovertemplate=f"{escape(curve.name)}, {x_title} %{{x}}: %{{y:.4g}}<extra></extra>",
        )
        named.add(curve.group)
    figure.update_xaxes(title={"text": x_title, **SMALL})
    figure.update_yaxes(title={"text": y_title, **SMALL}, rangemode="tozero")
    figure.update_layout(legend={"orientation": "h", "y": 1.02, "yanchor": "bottom", "x": 0})
    return _taller_where_narrow(plain(figure, 340), sum(map(_lines, groups)) if len(groups) > 1 else 0)


def with_narrow(figure: go.Figure, narrow: go.Figure) -> go.Figure:
    """Give a figure another layout for screens as narrow as a phone's; see figures.js.

    Args:
        figure: to be drawn.
        narrow: the same traces on the same axes, differently arranged.
    """
    figure.layout.meta = {"narrow": narrow.layout.to_plotly_json()}
    return figure


def _taller_where_narrow(figure: go.Figure, entries: int) -> go.Figure:
    """Room for a legend whose entries stand below each other."""
    narrow = go.Figure(layout=figure.layout)
    narrow.update_layout(height=figure.layout.height + 20 * entries)
    return with_narrow(figure, narrow)


def plain(figure: go.Figure, height: int) -> go.Figure:
    """Give a figure the pages' style."""
    figure.update_layout(
        template="none",
        height=height,
        margin={"l": 52, "r": 12, "t": 34, "b": 42},
        font={"color": MUTED, "size": 11.5, "family": FONT},
        paper_bgcolor="white",
        plot_bgcolor="white",
        hoverlabel={"bgcolor": "white", "bordercolor": RULE, "font": {"color": INK, "size": 12}},
        dragmode=False,
    )
    figure.update_layout(legend={"font": {"color": INK, "size": 12}})
    figure.update_xaxes(gridcolor=RULE, zeroline=False, linecolor=RULE, fixedrange=True)
    figure.update_yaxes(gridcolor=RULE, zeroline=False, fixedrange=True)
    # Titles of the charts in a figure stand flush with their axes.
    for k, title in enumerate(figure.layout.annotations):
        axis = figure.layout["xaxis" if k == 0 else f"xaxis{k + 1}"]
        title.update(x=axis.domain[0], xanchor="left", font={"size": 13, "color": INK})
    return figure


def wrapped(label: str) -> str:
    """A label of any length as HTML, in lines."""
    return "<br>".join(escape(line) for line in textwrap.wrap(label, LABEL_WIDTH)) or " "


def _lines(label: str) -> int:
    return max(1, len(textwrap.wrap(label, LABEL_WIDTH)))


def _titled(title: str, unit: str) -> str:
    return escape(f"{title} [{unit}]" if unit else title)


def _mean(values: npt.NDArray[np.float64], axis: int) -> npt.NDArray[np.float64]:
    """Mean over the values that there are; NaN where there are none, without a warning."""
    known = np.isfinite(values)
    count = known.sum(axis=axis)
    total = np.where(known, values, 0.0).sum(axis=axis)
    result: npt.NDArray[np.float64] = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    return result
