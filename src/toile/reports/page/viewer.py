"""The video and the cloth side by side, moved by one slider (viewer.js)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
import numpy.typing as npt

from toile.geometry.camera import Camera
from toile.reports.cloth_fields import ClothField, Upright
from toile.reports.page.document import data, figure, floats, picture_address
from toile.reports.playback import TOWARDS_CAMERA, WIRE_EVERY, playback

MAX_POINTS = 800
"""Ground-truth points drawn per frame."""
SPEEDS = {"1": "real time", "0.5": "½ speed", "0.25": "¼ speed", "0.1": "⅒ speed"}
COMFORTABLE_SECONDS = 4.0
"""A shorter clip is played slower at first."""

_PLAY = '<svg class="play" viewBox="0 0 16 16" aria-hidden="true"><path d="M4 2v12l10-6z"/></svg>'
_PAUSE = (
    '<svg class="pause" viewBox="0 0 16 16" aria-hidden="true">'
    '<path d="M3 2h3.5v12H3zM9.5 2H13v12H9.5z"/></svg>'
)


@dataclass(frozen=True)
class Video:
    """Pictures of every frame, as seen by one camera.

    Attributes:
        camera: of the pictures' proportions; its pixels need not be theirs.
        pictures: by the name of the view, e.g. "observed"; one RGB picture (h, w, 3), uint8, per frame.
    """

    camera: Camera
    pictures: Mapping[str, Sequence[npt.NDArray[np.uint8]]]


def viewer(
    positions: npt.NDArray[np.floating],
    fps: float,
    *,
    video: Video | None,
    shade: ClothField | None,
    ground_truth: Sequence[npt.NDArray[np.floating]] | None,
    fields: Sequence[ClothField],
    upright: Upright,
    times: npt.NDArray[np.floating] | None = None,
) -> str:
    """The viewer as HTML, with the data of everything that follows its slider.

    Args:
        positions: trajectory (F, H, W, 3) [m], camera frame.
        fps: frames per second.
        video: pictures of the same frames, or None.
        shade: colours the cloth.
        ground_truth: ground-truth points (N_f, 3) [m], one array per frame, or None.
        fields: maps of the page.
        upright: how those are turned.
        times: of the frames (F,) [s], for the clock; None for frame f at f / fps. Playing is at ``fps``.
    """
    F, H, W = positions.shape[:3]
    clouds = None if ground_truth is None else [_thinned(c) for c in ground_truth]
    content = {
        "frames": F,
        "rows": H,
        "columns": W,
        "fps": fps,
        **({} if times is None else {"times": times.tolist()}),
        "wire_every": WIRE_EVERY,
        "towards_camera": TOWARDS_CAMERA,
        "positions": floats(positions),
        "shade": None if shade is None else shade.key,
        "cloud": None
        if clouds is None
        else {
            "points": floats(np.concatenate(clouds)),
            "starts": np.cumsum([0, *map(len, clouds)]).tolist(),
        },
        "upright": {"transposed": upright.transposed, "flipped": upright.flipped},
        "fields": {f.key: floats(f.values) for f in ([*fields, shade] if shade else fields)},
        "video": None if video is None else _video_data(video),
    }
    panes = "".join((_video_pane(video), _space_pane(positions, shade, clouds)))
    alone = "" if video is not None else " alone"
    return (
        '<section class="viewer" id="viewer" aria-label="The video and the cloth, frame by frame">'
        f'<div class="panes{alone}">{panes}</div>{_transport(F, fps)}{data("viewer-data", content)}</section>'
    )


def _thinned(cloud: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
    return cloud[:: -(-len(cloud) // MAX_POINTS)] if len(cloud) > MAX_POINTS else cloud


def _video_data(video: Video) -> dict[str, object]:
    c = video.camera
    pictures = {name: [picture_address(p) for p in frames] for name, frames in video.pictures.items()}
    return {"camera": {"fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy}, "pictures": pictures}


def _video_pane(video: Video | None) -> str:
    if video is None:
        return ""
    choices = "".join(
        f'<label><input type="radio" name="view" value="{escape(name)}"{" checked" if k == 0 else ""}>'
        f"{escape(name)}</label>"
        for k, name in enumerate(video.pictures)
    )
    c = video.camera
    return (
        '<figure class="pane"><div class="pane-head">'
        f'<div class="segmented" role="radiogroup" aria-label="Picture">{choices}</div>'
        '<label class="check"><input type="checkbox" id="show-grid" checked>reconstructed grid</label></div>'
        f'<div class="stage"><div class="picture" style="--aspect: {c.width} / {c.height}">'
        '<img id="frame-picture" alt="The current frame of the video">'
        f'<svg viewBox="0 0 {c.width} {c.height}" aria-hidden="true"><path id="frame-grid"/></svg>'
        "</div></div></figure>"
    )


def _space_pane(
    positions: npt.NDArray[np.floating],
    shade: ClothField | None,
    clouds: Sequence[npt.NDArray[np.floating]] | None,
) -> str:
    points = (
        '<label class="check"><input type="checkbox" id="show-truth" checked>'
        '<span class="swatch"></span>ground-truth points</label>'
        if clouds is not None
        else ""
    )
    view = figure(playback(positions, shade, clouds), "playback")
    return (
        '<figure class="pane"><div class="pane-head"><span class="pane-title">The cloth in 3D</span>'
        f"{points}</div>"
        f'<div class="stage">{view}</div></figure>'
    )


def _transport(n_frames: int, fps: float) -> str:
    fitting = [s for s in SPEEDS if n_frames / fps / float(s) >= COMFORTABLE_SECONDS]
    chosen = fitting[0] if fitting else list(SPEEDS)[-1]
    options = "".join(
        f'<option value="{value}"{" selected" if value == chosen else ""}>{label}</option>'
        for value, label in SPEEDS.items()
    )
    return (
        '<div class="transport"><button type="button" id="play" aria-label="Play" aria-pressed="false">'
        f"{_PLAY}{_PAUSE}</button>"
        f'<input type="range" id="frame" min="0" max="{n_frames - 1}" value="0" step="1" aria-label="Frame">'
        '<output id="clock" for="frame"></output>'
        f'<select id="speed" aria-label="Speed">{options}</select></div>'
    )
