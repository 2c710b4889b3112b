"""Charts of the diagnosis page (plotly): held-out errors, scores over time, alias matrix."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from html import escape

import numpy as np
import numpy.typing as npt
import plotly.graph_objects as go
from scipy.cluster.hierarchy import leaves_list, linkage, optimal_leaf_ordering
from scipy.spatial.distance import squareform

from toile.diagnosis.record import Alias, EffectReport
from toile.reports.cloth_fields import ClothField, Upright
from toile.reports.diagnosis_wording import change, metric_and_unit, plain_name
from toile.reports.page.charts import CURSOR, MAP_HEIGHT, SMALL, plain
from toile.reports.palette import FORCE_SCALE, INK, MUTED, RECONSTRUCTION, RULE, SERIES

_PLACEBO, _OTHER = SERIES[1], "#8795a6"
_SCORED = 18
"""Names up to which an alias matrix has room for numbers."""
_WORTH_A_NUMBER = 0.5
_ROOM = 1.1
"""End of an axis over the farthest mark: as far as half of a mark, or of the number above it, reaches."""


def held_out(effects: Sequence[EffectReport], chosen: Collection[str]) -> go.Figure | None:
    """Error on held-out frames without and with each effect, beside the best placebo; None without any.

    Args:
        effects: those without a shrink, or with another metric than the first one's, are passed over.
        chosen: names that are drawn in the colour of the answer.
    """
    having = [(e, e.shrink) for e in effects if e.shrink is not None]
    having = [(e, s) for e, s in having if s.metric == having[0][1].metric]
    if not having:
        return None
    what, unit = metric_and_unit(having[0][1].metric)
    figure = go.Figure()
    known: set[str] = set()

    def mark(name: str, x: float, row: int, text: str, marker: dict[str, object]) -> None:
        figure.add_scatter(
            x=[x],
            y=[row],
            mode="markers",
            name=name,
            legendgroup=name,
            showlegend=name not in known,
            marker=marker,
            hovertemplate=f"{text}: %{{x:.3g}} {escape(unit)}<extra></extra>",
        )
        known.add(name)

    for row, (effect, s) in enumerate(having):
        colour = RECONSTRUCTION if effect.name in chosen else _OTHER
        low, high = s.base * (1 - s.high), s.base * (1 - s.low)
        for ends, width in (((s.base, s.with_effect), 2), ((low, high), 7)):
            figure.add_scatter(
                x=list(ends),
                y=[row, row],
                mode="lines",
                line={"color": colour, "width": width},
                opacity=1 if width == 2 else 0.28,
                hoverinfo="skip",
                showlegend=False,
            )
        name = escape(plain_name(effect.name))
        mark(
            "base model", s.base, row, "base model",
            {"color": "white", "size": 11, "line": {"color": INK, "width": 2}},
        )  # fmt: skip
        if s.best_placebo is not None:
            text = f"best placebo, {change(s.best_placebo)}"
            mark("best placebo", s.base * (1 - s.best_placebo), row, text,
                 {"color": _PLACEBO, "size": 10, "symbol": "diamond"})  # fmt: skip
        text = f"with {name}, {change(s.estimate)}"
        mark("with the effect (and 90 % interval)", s.with_effect, row, text,
             {"color": colour, "size": 12})  # fmt: skip
        figure.add_annotation(
            x=s.with_effect,
            y=row,
            text=f"<b>{change(s.estimate)}</b>",
            showarrow=False,
            yshift=17,
            font={"size": 13, "color": INK if effect.name in chosen else MUTED},
        )
    figure.update_yaxes(
        range=[len(having) - 0.45, -0.6],
        tickmode="array",
        tickvals=list(range(len(having))),
        ticktext=[escape(plain_name(e.name)) for e, _ in having],
        tickfont={"size": 14, "color": INK},
        automargin=True,
        showgrid=False,
    )
    # In two lines, as the chart is half a page wide at most.
    title = [f"{what} [{unit}]" if unit else what, having[0][1].held_out]
    farthest = max(x for trace in figure.data for x in trace.x)
    figure.update_xaxes(
        title={"text": "<br>".join(map(escape, title)), **SMALL}, range=[0.0, _ROOM * farthest]
    )
    figure.update_layout(
        legend={"orientation": "h", "y": 1.04, "yanchor": "bottom", "x": 0, "xanchor": "left"}
    )
    annotations = figure.layout.annotations
    # The pages' style takes annotations for titles of charts.
    figure.layout.annotations = ()
    plain(figure, 62 * len(having) + 142)
    figure.layout.annotations = annotations
    figure.update_layout(margin={"l": 8, "t": 66, "b": 58})
    return figure


def over_time(
    scores: Sequence[float],
    held_out_frames: Collection[int],
    *,
    cursor: bool,
    clips: Mapping[str, int] | None = None,
) -> go.Figure | None:
    """Score of every frame; the frames that were held out are shaded. None without scores.

    Args:
        scores: mean distance of every frame over the median distance (F,).
        held_out_frames: a score of exactly 0 there was not measured.
        cursor: draw a line for the current frame.
        clips: numbers of frames by name, one after the other, F in all; frames are counted anew in each.
            None for one clip.

    Raises:
        ValueError: the clips have not F frames in all.
    """
    if not scores:
        return None
    if clips is None:
        clips = {"": len(scores)}
    if sum(clips.values()) != len(scores):
        raise ValueError(f"clips of {sum(clips.values())} frames in all, scores of {len(scores)}")
    values = [None if f in held_out_frames and v == 0 else v for f, v in enumerate(scores)]
    figure = go.Figure()
    figure.add_bar(
        x=list(range(len(values))),
        y=values,
        customdata=[escape(f"{clip}, frame {k}".lstrip(", ")) for clip, n in clips.items() for k in range(n)],
        marker={"color": RECONSTRUCTION, "line": {"width": 0}},
        hovertemplate="%{customdata}: %{y:.3g} × the median<extra></extra>",
        showlegend=False,
    )
    if cursor:
        figure.add_shape(**CURSOR, xref="x", yref="y domain")
    figure.add_hline(y=1, line={"color": MUTED, "width": 1, "dash": "dot"})
    if held_out_frames:
        first, last = min(held_out_frames), max(held_out_frames)
        figure.add_vrect(first - 0.5, last + 0.5, fillcolor="#f1f3f6", line_width=0, layer="below")
        figure.add_annotation(
            x=first - 0.5, y=1, xref="x", yref="y domain", text="held out", showarrow=False, xanchor="left",
            yanchor="top", xshift=6, font={"size": 12, "color": MUTED},
        )  # fmt: skip
    annotations = figure.layout.annotations
    figure.layout.annotations = ()
    plain(figure, 230)
    figure.layout.annotations = annotations
    figure.update_xaxes(title={"text": "frame", **SMALL}, range=[-0.6, len(scores) - 0.4], showgrid=False)
    figure.update_yaxes(title={"text": "distance / median", **SMALL}, rangemode="tozero")
    figure.update_layout(margin={"t": 12}, bargap=0.25)
    if len(clips) > 1:
        _part_clips(figure, clips)
    return figure


def _part_clips(figure: go.Figure, clips: Mapping[str, int]) -> None:
    """Name each clip above its frames, count these from 0, and draw a line before all but the first."""
    longest = max(clips.values())
    step = next((s for s in (10, 20, 50, 100, 200, 500) if longest <= 5 * s), 1000)
    places: list[int] = []
    counts: list[str] = []
    first = 0
    for clip, n in clips.items():
        if first:
            figure.add_vline(first - 0.5, line={"color": MUTED, "width": 1}, layer="below")
        figure.add_annotation(
            x=first + n / 2 - 0.5, y=1, xref="x", yref="y domain", text=escape(clip), showarrow=False,
            yanchor="bottom", font={"size": 12, "color": MUTED},
        )  # fmt: skip
        here = range(0, n, step)
        places += [first + k for k in here]
        counts += [str(k) for k in here]
        first += n
    figure.update_xaxes(title={"text": "frame of the clip"}, tickvals=places, ticktext=counts)
    figure.update_layout(margin={"t": 30})


def mean_map(field: ClothField, upright: Upright | None) -> go.Figure:
    """A single map of one value per vertex, for a diagnosis without a tracked motion.

    Args:
        field: values (1, H, W).
        upright: how the cloth lies in the image, where that is known.
    """
    values = field.values[0] if upright is None else upright(field.values[0])
    figure = go.Figure(
        go.Heatmap(
            z=values,
            colorscale=[list(stop) for stop in field.scale],
            zmin=0.0,
            zmax=field.limit,
            colorbar={"title": {"text": field.unit}, "thickness": 12, "outlinewidth": 0},
            hovertemplate=f"row %{{y}}, column %{{x}}: %{{z:.3g}} {escape(field.unit)}<extra></extra>",
        )
    )
    plain(figure, MAP_HEIGHT)
    bare = {"showticklabels": False, "ticks": "", "showgrid": False, "constrain": "domain"}
    figure.update_xaxes(scaleanchor="y", **bare)
    figure.update_yaxes(autorange="reversed", **bare)
    return figure


def alias_order(alias: Alias) -> list[int]:
    """Indices of the names so that those with the same trace stand beside each other."""
    n = len(alias.names)
    if n < 3:
        return list(range(n))
    matrix = np.array(alias.matrix)
    away = np.clip(1 - np.abs(0.5 * (matrix + matrix.T)), 0, None)
    np.fill_diagonal(away, 0.0)
    pairs = squareform(away, checks=False)
    return [int(i) for i in leaves_list(optimal_leaf_ordering(linkage(pairs, "average"), pairs))]


def alias_matrix(alias: Alias, chosen: Collection[str] = ()) -> go.Figure | None:
    """|cosine| between the traces of every pair of names, one half of it; None for fewer than two names."""
    n = len(alias.names)
    if n < 2:
        return None
    order = alias_order(alias)
    matrix = np.array(alias.matrix, dtype=float)[np.ix_(order, order)]
    names = [alias.names[i] for i in order]
    half: npt.NDArray[np.float64] = np.where(np.tri(n, k=-1, dtype=bool), matrix, np.nan)[1:, :-1]
    text = [
        ["" if np.isnan(v) or v < _WORTH_A_NUMBER else f"{v:.2f}".lstrip("0") for v in row] for row in half
    ]
    labels = [
        f"<b>{escape(plain_name(name))}</b>" if name in chosen else escape(plain_name(name)) for name in names
    ]
    # By number, as two names could read alike.
    pairs = [[f"{labels[i + 1]} and {labels[j]}" for j in range(n - 1)] for i in range(n - 1)]
    figure = go.Figure(
        go.Heatmap(
            z=half,
            text=text if n <= _SCORED else None,
            texttemplate="%{text}" if n <= _SCORED else None,
            textfont={"size": 11},
            customdata=pairs,
            hovertemplate="%{customdata}: %{z:.2f}<extra></extra>",
            hoverongaps=False,
            colorscale=[list(stop) for stop in FORCE_SCALE],
            zmin=0.0,
            zmax=1.0,
            xgap=2,
            ygap=2,
            colorbar={
                "title": {"text": "|cosine|", "side": "top", "font": {"size": 11.5}},
                "orientation": "h", "thickness": 10, "len": 0.4, "x": 1, "xanchor": "right", "y": 1,
                "yanchor": "top", "outlinewidth": 0, "tickvals": [0, 0.5, 1],
            },
        )
    )  # fmt: skip
    plain(figure, 30 * n + 130)
    ticks = {"tickmode": "array", "tickvals": list(range(n - 1)), "showgrid": False, "linecolor": RULE}
    figure.update_xaxes(
        ticktext=labels[:-1], tickangle=-40, tickfont={"size": 12, "color": INK}, automargin=True, **ticks
    )
    figure.update_yaxes(
        ticktext=labels[1:], range=[n - 1.5, -0.5], tickfont={"size": 12, "color": INK}, automargin=True,
        **ticks,
    )  # fmt: skip
    figure.update_layout(margin={"l": 8, "t": 8, "b": 8})
    return figure
