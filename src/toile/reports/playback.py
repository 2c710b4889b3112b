"""Interactive three-dimensional playback of a reconstruction (plotly)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import plotly.graph_objects as go
from scipy.spatial import cKDTree

from toile.reports.palette import ERROR_SCALE, GROUND_TRUTH, INK, MUTED, RULE

MAX_POINTS = 1500
"""Ground-truth points drawn per frame."""
WIRE_EVERY = 3
"""Every how many grid lines one is drawn over the surface."""
TOWARDS_CAMERA = 0.992
"""Lifts the grid lines off the surface, towards the camera at the origin, or it would hide them."""
PLAIN_SURFACE = "#9db8d6"


def distance_to_points(
    positions: npt.NDArray[np.floating], ground_truth: Sequence[npt.NDArray[np.floating]]
) -> npt.NDArray[np.float64]:
    """Distance of every vertex to the nearest ground-truth point of its frame, (F, H, W) [m]."""
    found = [
        cKDTree(np.asarray(cloud, dtype=np.float64))
        .query(x.reshape(-1, 3), workers=1)[0]
        .reshape(x.shape[:2])
        for x, cloud in zip(positions, ground_truth, strict=False)
    ]
    return np.stack(found)


def playback(
    positions: npt.NDArray[np.floating],
    fps: float,
    ground_truth: Sequence[npt.NDArray[np.floating]] | None = None,
) -> go.Figure:
    """Animate the cloth; with ground truth its colour is the error and the true points are shown.

    Shown with x to the right, depth away from the viewer and height −y upwards, in proportion, all axes fixed
    over the whole motion.

    Args:
        positions: trajectory (F, H, W, 3) [m], camera frame.
        fps: frames per second.
        ground_truth: ground-truth points (N_f, 3) [m], one array per frame, or None.
    """
    error = None if ground_truth is None else 1e3 * distance_to_points(positions, ground_truth)
    limit = 1.0 if error is None else max(1.0, float(np.percentile(error, 99)))
    clouds = None if ground_truth is None else [c[:: max(1, len(c) // MAX_POINTS)] for c in ground_truth]

    def traces(f: int) -> list[Any]:
        surface = _surface(positions[f], None if error is None else error[f], limit)
        drawn = [surface, _wires(positions[f])]
        if clouds is not None:
            drawn.append(_points(clouds[f]))
        return drawn

    n = len(positions)
    figure = go.Figure(
        data=traces(0), frames=[go.Frame(data=traces(f), name=str(f), traces=None) for f in range(n)]
    )
    everything = [positions.reshape(-1, 3)] + ([] if clouds is None else [np.concatenate(clouds)])
    figure.update_layout(
        height=620,
        margin={"l": 0, "r": 0, "t": 8, "b": 8},
        paper_bgcolor="white",
        font={"color": INK, "size": 12},
        scene=_scene(np.concatenate(everything)),
        legend={"x": 0.01, "y": 0.98, "bgcolor": "rgba(255,255,255,0.7)", "itemsizing": "constant"},
        updatemenus=[_buttons(fps)],
        sliders=[_slider(n)],
    )
    return figure


def _display(points: npt.NDArray[np.floating]) -> tuple[npt.NDArray[np.float32], ...]:
    """Camera frame to the axes of the plot: right, away, up."""
    p = points.astype(np.float32)
    return p[..., 0], p[..., 2], -p[..., 1]


def _surface(x: npt.NDArray[np.floating], error: npt.NDArray[np.float64] | None, limit: float) -> go.Surface:
    right, away, up = _display(x)
    shade: dict[str, Any] = {
        "surfacecolor": np.zeros(x.shape[:2], dtype=np.float32),
        "colorscale": [[0, PLAIN_SURFACE], [1, PLAIN_SURFACE]],
        "showscale": False,
    }
    if error is not None:
        shade = {
            "surfacecolor": error.astype(np.float32),
            "colorscale": [list(stop) for stop in ERROR_SCALE],
            "cmin": 0.0,
            "cmax": limit,
            "colorbar": {
                "title": {"text": "distance to<br>ground truth [mm]", "font": {"size": 11}},
                "thickness": 12,
                "len": 0.6,
            },
        }
    return go.Surface(
        x=right,
        y=away,
        z=up,
        name="reconstruction",
        showlegend=False,
        hovertemplate="x %{x:.3f} m<br>depth %{y:.3f} m<br>height %{z:.3f} m<extra></extra>",
        lighting={"ambient": 0.9, "diffuse": 0.3, "specular": 0.02, "roughness": 0.9},
        **shade,
    )


def _wires(x: npt.NDArray[np.floating]) -> go.Scatter3d:
    """Some of the grid lines, joined into one trace with gaps."""
    gap = np.full((1, 3), np.nan)
    last = (x.shape[0] - 1, x.shape[1] - 1)
    rows = sorted({*range(0, x.shape[0], WIRE_EVERY), last[0]})
    columns = sorted({*range(0, x.shape[1], WIRE_EVERY), last[1]})
    lines = [np.concatenate((x[i], gap)) for i in rows] + [np.concatenate((x[:, j], gap)) for j in columns]
    right, away, up = _display(TOWARDS_CAMERA * np.concatenate(lines))
    return go.Scatter3d(
        x=right,
        y=away,
        z=up,
        mode="lines",
        line={"color": "rgba(28,36,48,0.55)", "width": 1.5},
        hoverinfo="skip",
        name="grid",
        showlegend=False,
    )


def _points(cloud: npt.NDArray[np.floating]) -> go.Scatter3d:
    right, away, up = _display(cloud)
    return go.Scatter3d(
        x=right,
        y=away,
        z=up,
        mode="markers",
        marker={"size": 1.6, "color": GROUND_TRUTH, "opacity": 0.65},
        hoverinfo="skip",
        name="ground truth",
        showlegend=True,
    )


def _scene(points: npt.NDArray[np.floating]) -> dict[str, Any]:
    """Fixed, proportional axes around all points, seen from the camera's side, a little from the right."""
    shown = np.stack(_display(points), axis=-1)
    low, high = shown.min(axis=0), shown.max(axis=0)
    margin = 0.05 * float((high - low).max())
    titles = ("x [m]", "depth z [m]", "height −y [m]")
    axes = {
        f"{axis}axis": {
            "title": {"text": title, "font": {"size": 11, "color": MUTED}},
            "range": [float(low[k]) - margin, float(high[k]) + margin],
            "backgroundcolor": "white",
            "gridcolor": RULE,
            "zerolinecolor": RULE,
            "tickfont": {"size": 10, "color": MUTED},
        }
        for k, (axis, title) in enumerate(zip("xyz", titles, strict=True))
    }
    # Proportional, with the longest side 1, so that the cloth fills the view whatever its depth.
    extent = (high - low) + 2 * margin
    ratio = {axis: float(extent[k] / extent.max()) for k, axis in enumerate("xyz")}
    eye = {"x": 0.75, "y": -1.45, "z": 0.35}
    return {**axes, "aspectmode": "manual", "aspectratio": ratio, "camera": {"eye": eye}}


def _buttons(fps: float) -> dict[str, Any]:
    play = {
        "frame": {"duration": 1000 / fps, "redraw": True},
        "transition": {"duration": 0},
        "fromcurrent": True,
        "mode": "immediate",
    }
    pause = {"frame": {"duration": 0, "redraw": False}, "mode": "immediate"}
    return {
        "type": "buttons",
        "direction": "left",
        "x": 0.0,
        "y": 0.0,
        "xanchor": "left",
        "yanchor": "top",
        "pad": {"t": 22, "r": 8},
        "showactive": False,
        "bgcolor": "white",
        "bordercolor": RULE,
        "buttons": [
            {"label": "▶ Play", "method": "animate", "args": [None, play]},
            {"label": "❚❚", "method": "animate", "args": [[None], pause]},
        ],
    }


def _slider(n_frames: int) -> dict[str, Any]:
    step = {"frame": {"duration": 0, "redraw": True}, "transition": {"duration": 0}, "mode": "immediate"}
    return {
        "x": 0.16,
        "len": 0.82,
        "y": 0.0,
        "pad": {"t": 8},
        "currentvalue": {"prefix": "frame ", "font": {"size": 12, "color": MUTED}},
        "bordercolor": RULE,
        "tickcolor": RULE,
        "font": {"size": 1, "color": "rgba(0,0,0,0)"},
        "steps": [{"label": str(f), "method": "animate", "args": [[str(f)], step]} for f in range(n_frames)],
    }
