"""The video and the cloth side by side, moved by one slider (viewer.html.j2, viewer.js)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
import plotly.graph_objects as go

from toile.geometry.camera import Camera
from toile.reports.cloth_fields import ClothField, Upright
from toile.reports.page.document import floats, picture_address
from toile.reports.playback import TOWARDS_CAMERA, WIRE_EVERY, playback

MAX_POINTS = 800
"""Ground-truth points drawn per frame."""
COMFORTABLE_SECONDS = 4.0
"""A shorter clip is played slower at first."""


@dataclass(frozen=True)
class Video:
    """Pictures of every frame, as seen by one camera.

    Attributes:
        camera: of the pictures' proportions; its pixels need not be theirs.
        pictures: by the name of the view, e.g. "observed"; one RGB picture (h, w, 3), uint8, per frame.
    """

    camera: Camera
    pictures: Mapping[str, Sequence[npt.NDArray[np.uint8]]]


@dataclass(frozen=True)
class Viewer:
    """What the viewer shows.

    Attributes:
        data: of everything that follows its slider, for viewer.js.
        playback: the cloth in 3D.
        video: pictures of the same frames, or None.
        speed: at first, one of ``SPEEDS``.
    """

    SPEEDS: ClassVar = {"1": "real time", "0.5": "½ speed", "0.25": "¼ speed", "0.1": "⅒ speed"}
    data: Mapping[str, Any]
    playback: go.Figure
    video: Video | None
    speed: str

    @classmethod
    def of(
        cls,
        positions: npt.NDArray[np.floating],
        fps: float,
        *,
        video: Video | None,
        shade: ClothField | None,
        ground_truth: Sequence[npt.NDArray[np.floating]] | None,
        fields: Sequence[ClothField],
        upright: Upright,
        times: npt.NDArray[np.floating] | None = None,
    ) -> Viewer:
        """The viewer of a motion.

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
        fitting = [s for s in cls.SPEEDS if F / fps / float(s) >= COMFORTABLE_SECONDS]
        speed = fitting[0] if fitting else list(cls.SPEEDS)[-1]
        return cls(content, playback(positions, shade, clouds), video, speed)


def _thinned(cloud: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
    return cloud[:: -(-len(cloud) // MAX_POINTS)] if len(cloud) > MAX_POINTS else cloud


def _video_data(video: Video) -> dict[str, object]:
    c = video.camera
    pictures = {name: [picture_address(p) for p in frames] for name, frames in video.pictures.items()}
    return {"camera": {"fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy}, "pictures": pictures}
