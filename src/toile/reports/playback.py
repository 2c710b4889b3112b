"""The three-dimensional view of a reconstruction (plotly); viewer.js fills in the frames."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import plotly.graph_objects as go

from toile.reports.cloth_fields import ClothField
from toile.reports.palette import FONT, GROUND_TRUTH, INK, MUTED, RULE

WIRE_EVERY = 3
"""Every how many grid lines one is drawn over the surface."""
TOWARDS_CAMERA = 0.992
"""Lifts the grid lines off the surface, towards the camera at the origin, or it would hide them."""
PLAIN_SURFACE = "#9db8d6"


def playback(
    positions: npt.NDArray[np.floating],
    shade: ClothField | None = None,
    ground_truth: Sequence[npt.NDArray[np.floating]] | None = None,
) -> go.Figure:
    """An empty view with fixed axes around the whole motion: surface, grid lines and perhaps true points.

    Shown with x to the right, depth away from the viewer and height −y upwards, in proportion.

    Args:
        positions: trajectory (F, H, W, 3) [m], camera frame.
        shade: colours the surface.
        ground_truth: ground-truth points (N_f, 3) [m], one array per frame, or None.
    """
    traces = [_surface(shade), _wires()]
    everything = [positions.reshape(-1, 3)]
    if ground_truth is not None:
        traces.append(_points())
        everything.append(np.concatenate(list(ground_truth)))
    figure = go.Figure(data=traces)
    figure.update_layout(
        template="none",
        margin={"l": 0, "r": 40, "t": 0, "b": 0},
        paper_bgcolor="white",
        font={"color": INK, "size": 12, "family": FONT},
        scene=_scene(np.concatenate(everything)),
        uirevision="one view",
        showlegend=False,
    )
    return figure


def _surface(shade: ClothField | None) -> go.Surface:
    colours: dict[str, Any] = {
        "colorscale": [[0, PLAIN_SURFACE], [1, PLAIN_SURFACE]],
        "showscale": False,
    }
    if shade is not None:
        colours = {
            "colorscale": [list(stop) for stop in shade.scale],
            "cmin": 0.0,
            "cmax": shade.limit,
            "colorbar": {
                "title": {"text": f"{shade.title.lower()} [{shade.unit}]", "font": {"size": 11.5}},
                "tickfont": {"size": 11, "color": MUTED},
                "thickness": 10,
                "len": 0.55,
                "x": 0.98,
                "xanchor": "left",
                "outlinewidth": 0,
            },
        }
    return go.Surface(
        name="reconstruction",
        hovertemplate="x %{x:.3f} m<br>depth %{y:.3f} m<br>height %{z:.3f} m<extra></extra>",
        lighting={"ambient": 0.9, "diffuse": 0.3, "specular": 0.02, "roughness": 0.9},
        contours={axis: {"highlight": False} for axis in "xyz"},
        **colours,
    )


def _wires() -> go.Scatter3d:
    return go.Scatter3d(
        mode="lines", line={"color": "rgba(28,36,48,0.55)", "width": 1.5}, hoverinfo="skip", name="grid"
    )


def _points() -> go.Scatter3d:
    marker = {"size": 1.6, "color": GROUND_TRUTH, "opacity": 0.65}
    return go.Scatter3d(mode="markers", marker=marker, hoverinfo="skip", name="ground truth")


def _scene(points: npt.NDArray[np.floating]) -> dict[str, Any]:
    """Fixed, proportional axes around all points, seen from the camera's side, a little from the right."""
    shown = points[:, [0, 2, 1]] * (1, 1, -1)
    low, high = shown.min(axis=0), shown.max(axis=0)
    margin = 0.05 * float((high - low).max())
    titles = ("x [m]", "depth z [m]", "height −y [m]")
    axes = {
        f"{axis}axis": {
            "title": {"text": title, "font": {"size": 11.5, "color": MUTED}},
            "range": [float(low[k]) - margin, float(high[k]) + margin],
            "backgroundcolor": "white",
            "gridcolor": RULE,
            "zerolinecolor": RULE,
            "tickfont": {"size": 10.5, "color": MUTED},
            "nticks": 5,
            "showspikes": False,
        }
        for k, (axis, title) in enumerate(zip("xyz", titles, strict=True))
    }
    # Proportional, with the longest side 1, so that the cloth fills the view whatever its depth.
    extent = (high - low) + 2 * margin
    ratio = {axis: float(extent[k] / extent.max()) for k, axis in enumerate("xyz")}
    # Far enough that the titles of the axes are not cut.
    eye, centre = {"x": 0.8, "y": -1.66, "z": 0.3}, {"x": 0.1, "y": 0.0, "z": -0.09}
    return {
        **axes,
        "aspectmode": "manual",
        "aspectratio": ratio,
        "camera": {"eye": eye, "center": centre},
        "dragmode": "turntable",
    }
