"""The page of a clip of a person in a garment: video, novel view, body and garment in 3D, measures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import igl
import numpy as np
import numpy.typing as npt
import plotly.graph_objects as go

from toile.atomic_file import write_text
from toile.capture.body.subject import Subject
from toile.capture.data.clips import TRUTH_FILE, Truth
from toile.capture.data.filming import Looks, drawn, looking_from
from toile.capture.garments.garment import Garment
from toile.capture.metrics.out_of_balance import (
    CONTACT_PROTOCOL,
    TOUCHING,
    ContactBalance,
    balance_with_contact,
)
from toile.errors import InputError
from toile.evaluation.penetration import (
    BODY_PENETRATION_PROTOCOL,
    PENETRATION_PROTOCOL,
    Penetration,
    penetration,
)
from toile.physics.cloth import mesh_cloth
from toile.physics.energies.membrane import Membrane, NeoHookean, StVenantKirchhoff
from toile.progress import Report, silent
from toile.rendering.warp.renderer import WarpRenderer
from toile.reports.page.charts import Panel, small_multiples
from toile.reports.page.document import floats, number, picture_address, render
from toile.reports.page.viewer import Video
from toile.reports.palette import ERROR_SCALE, FONT, FORCE_SCALE, INK, MUTED, RULE
from toile.scenes.multi_view import load_multi_view
from toile.scenes.views import MultiView

PAGE_FILE = "index.html"
_BODY_FACES = 3000  # of the body as it is shown; the page would weigh ten times as much
_SCRIPTS = ("figures.js", "capture.js", "table.js", "start.js")
_PLAIN = ((0.0, "#9db8d6"), (1.0, "#9db8d6"))
_LAWS = {law.__name__: law for law in (NeoHookean, StVenantKirchhoff)}

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class GarmentMap:
    """Colours of the garment.

    Attributes:
        key: of the map within the page.
        title: short name.
        unit: of the values.
        values: (F, N), or None for one plain colour.
        scale: colour scale.
    """

    key: str
    title: str
    unit: str
    values: Floats | None
    scale: Sequence[tuple[float, str]]

    @property
    def limit(self) -> float:
        """Value of the last colour: single vertices must not make all others look the same."""
        if self.values is None or not np.isfinite(self.values).any():
            return 1.0
        return max(float(np.nanpercentile(self.values, 99.5)), 1e-6)


@dataclass(frozen=True)
class CapturePage:
    """What the page of a clip shows.

    Attributes:
        name: of the clip.
        truth: motion of body and garment, the true one or one that was reconstructed.
        frames: numbers of the frames shown.
        video: pictures of these frames by name.
        measured: penetration.
        balance: out-of-balance force, or None where the garment's material is not known.
        protocols: how it was measured.
    """

    name: str
    truth: Truth
    frames: Sequence[int]
    video: Video
    measured: Penetration
    balance: ContactBalance | None
    protocols: Sequence[str]

    @property
    def n_frames(self) -> int:
        """Frames of the clip."""
        return self.truth.n_frames

    @property
    def fps(self) -> float:
        """Frames per second."""
        return self.truth.fps

    @property
    def body_size(self) -> int:
        """Vertices of the body."""
        return self.truth.body_positions.shape[1]

    @property
    def garment_size(self) -> int:
        """Vertices of the garment."""
        return self.truth.garment_positions.shape[1]

    @property
    def maps(self) -> list[GarmentMap]:
        """What the garment can be coloured by."""
        found = [
            GarmentMap("plain", "plain", "", None, _PLAIN),
            GarmentMap("depth", "penetration", "mm", 1e3 * self.measured.depths, ERROR_SCALE),
        ]
        if self.balance is not None:
            weights = self.balance.forces / self.balance.mean_weight
            found.append(GarmentMap("force", "out-of-balance force", "weights", weights, FORCE_SCALE))
        return found

    def render(self) -> str:
        """The page as HTML text, self-contained."""
        panels = self._panels()
        chosen = list(self.frames)
        body, faces = shown_body(self.truth)
        data: dict[str, Any] = {
            "frames": chosen,
            "total": self.n_frames,
            "fps": self.fps,
            "meshes": [
                {"vertices": x.shape[1], "positions": floats(x[chosen])}
                for x in (body, self.truth.garment_positions)
            ],
            "maps": [
                {
                    "key": m.key,
                    "title": m.title,
                    "unit": m.unit,
                    "limit": m.limit,
                    "scale": [list(stop) for stop in m.scale],
                    "values": None if m.values is None else floats(m.values[chosen]),
                }
                for m in self.maps
            ],
            "pictures": {
                name: [picture_address(picture) for picture in pictures]
                for name, pictures in self.video.pictures.items()
            },
        }
        return render(
            "capture.html.j2",
            page=self,
            scripts=_SCRIPTS,
            cards=self._cards(),
            data=data,
            space=_space(body, faces, self.truth.garment_positions, self.truth.garment_faces),
            panels=panels,
            charts=small_multiples(panels, np.arange(self.n_frames, dtype=float), "frame", cursors=True),
        )

    def _cards(self) -> list[tuple[Any, str, str]]:
        found = self.measured
        cards: list[tuple[Any, str, str]] = [
            (number(1e3 * found.maximum), "mm", "largest penetration of a garment's vertex"),
            (number(1e3 * found.body_maximum), "mm", "largest, of a body's vertex through the garment"),
            (number(100 * found.share), "%", "vertices that penetrate"),
        ]
        if self.balance is not None:
            cards += [
                (number(self.balance.average_weights), "weights", "out-of-balance force, average"),
                (number(self.balance.maximum_weights), "weights", "out-of-balance force, largest"),
            ]
        return cards

    def _panels(self) -> list[Panel]:
        depths, body = self.measured.depths, self.measured.body_depths
        panels = [
            Panel("Largest penetration of the garment", "mm", 1e3 * np.nanmax(depths, 1, initial=0.0)),
            Panel("Body through the garment", "mm", 1e3 * body.max(1)),
        ]
        if self.balance is not None:
            forces = self.balance.forces / self.balance.mean_weight
            inner = np.isfinite(forces).any(1)
            mean = np.full(len(forces), math.nan)
            mean[inner] = np.nanmean(forces[inner], 1)
            panels.append(Panel("Out-of-balance force", "weights", mean))
        return panels


def write_capture_page(clip: Path, view: int = 0, every: int = 1, report: Report = silent) -> Path:
    """Measure a clip of a data set and write its page beside it.

    Args:
        clip: folder with scene.json and truth.npz; subject.npz and true_garment.npz are looked for one up.
        view: camera whose images are shown.
        every: only so many frames are shown.
        report: progress.

    Returns:
        The page, ``index.html``.

    Raises:
        InputError: the clip cannot be read, or has no such camera.
    """
    truth = Truth.load(clip / TRUTH_FILE)
    recording = load_multi_view(clip)
    _check_shown(recording, view, every)
    subject = None
    if (clip.parent / "subject.npz").is_file():
        subject = Subject.load(clip.parent / "subject.npz")
    garment = _garment_of(clip, truth)
    law = _law(truth)
    page = _page_of(truth, recording, view, every, subject, garment, law, report, name=clip.name)
    return write_text(clip / PAGE_FILE, page.render())


def write_prediction_page(
    motion: Truth,
    recording: MultiView,
    subject: Subject,
    garment: Garment,
    file: Path,
    *,
    name: str,
    view: int = 0,
    every: int = 1,
    report: Report = silent,
) -> Path:
    """Measure what was reconstructed from one camera and write its page; no truth is needed.

    Args:
        motion: body and garment as they were reconstructed.
        recording: what was filmed.
        subject: whose body.
        garment: the model's.
        file: of the page.
        name: of the clip.
        view: camera that was reconstructed from.
        every: only so many frames are shown.
        report: progress.

    Raises:
        InputError: no such camera.
    """
    _check_shown(recording, view, every)
    known = garment if motion.n_frames > 2 else None
    page = _page_of(motion, recording, view, every, subject, known, None, report, name=name)
    return write_text(file, page.render())


def _check_shown(recording: MultiView, view: int, every: int) -> None:
    if not 0 <= view < len(recording.views) or every < 1:
        raise InputError(
            "No such view",
            where="view, every",
            expected=f"a camera from 0 to {len(recording.views) - 1}, every frame or fewer",
            got=f"{view}, {every}",
        )


def _page_of(
    motion: Truth,
    recording: MultiView,
    view: int,
    every: int,
    subject: Subject | None,
    garment: Garment | None,
    law: type[Membrane] | None,
    report: Report,
    *,
    name: str,
) -> CapturePage:
    """Measured and drawn.

    Args:
        motion: true or reconstructed.
        recording: what was filmed.
        view: camera whose images are shown.
        every: only so many frames are shown.
        subject: whose arms take no part, if it is known.
        garment: of the motion, if it is known.
        law: of the truth's garment; None for a reconstruction, whose garment is the simulation layer's.
        report: progress.
        name: of the clip.
    """
    report("measuring", 0, None)
    inactive = held = balance = None
    body, cloth = motion.body_positions, motion.garment_positions
    if subject is not None:
        inactive = subject.parts["arms"].numpy()
    protocols = [PENETRATION_PROTOCOL, BODY_PENETRATION_PROTOCOL]
    if garment is not None:
        held = garment.attached.numpy()
        rest, density = garment.rest_vertices, garment.material.density
        attached = tuple(garment.attached.tolist())
        model = mesh_cloth(rest, garment.faces, density, attached, law or NeoHookean, flat=law is None)
        balance = balance_with_contact(
            garment, model, cloth, body, motion.body_faces, motion.fps, inactive=inactive
        )
        drag = "; air drag counts as missing" if law is not None else ""
        protocols.append(CONTACT_PROTOCOL.format(distance=1e3 * TOUCHING) + drag)
    measured = penetration(cloth, motion.garment_faces, body, motion.body_faces, held=held, inactive=inactive)
    frames = range(0, motion.n_frames, every)
    seen = recording.views[view]
    between = looking_from(recording.cameras[view], math.pi / max(2, len(recording.views)))
    looks = Looks.random(np.random.default_rng(0), between.width)
    report("drawing", 0, None)
    renderer = WarpRenderer(2)
    observed = [(255 * seen.frame(k)).round().byte().numpy() for k in frames]
    pictures = {f"camera {seen.name}": observed}
    if law is None:
        pictures["reconstruction over it"] = drawn(
            motion, seen.camera, looks, renderer, frames, [picture / 255 for picture in observed]
        )
    pictures["novel view"] = drawn(motion, between, looks, renderer, frames)
    video = Video(seen.camera, pictures)
    return CapturePage(name, motion, list(frames), video, measured, balance, protocols)


def shown_body(truth: Truth) -> tuple[Floats, npt.NDArray[np.int64]]:
    """The body with fewer faces: positions (F, V', 3) [m] of some of its vertices, and faces of these."""
    if len(truth.body_faces) <= _BODY_FACES:
        return truth.body_positions, truth.body_faces
    _, faces, _, kept = igl.decimate(
        np.ascontiguousarray(truth.body_positions[0]), np.ascontiguousarray(truth.body_faces), _BODY_FACES
    )[-4:]
    return truth.body_positions[:, kept], np.asarray(faces, dtype=np.int64)


def _law(truth: Truth) -> type[Membrane]:
    return _LAWS.get(str(truth.extra.get("membrane", "")), NeoHookean)


def _garment_of(clip: Path, truth: Truth) -> Garment | None:
    """The garment of the truth, where it lies beside the clip."""
    path = clip.parent / "true_garment.npz"
    garment = Garment.load(path) if path.is_file() else None
    fits = garment is not None and len(garment.rest_vertices) == truth.garment_positions.shape[1]
    return garment if fits and truth.n_frames > 2 else None


def _space(
    body: Floats, body_faces: npt.NDArray[np.int64], garment: Floats, garment_faces: npt.NDArray[np.int64]
) -> go.Figure:
    """Body and garment in 3D, empty: capture.js fills in the frames; fixed axes around the whole motion."""
    light = {"ambient": 0.65, "diffuse": 0.5, "specular": 0.03, "roughness": 0.9}
    bar = {"thickness": 10, "len": 0.55, "tickfont": {"size": 11, "color": MUTED}, "outlinewidth": 0}
    figure = go.Figure(
        data=[
            go.Mesh3d(
                **dict(zip("ijk", body_faces.T.tolist(), strict=True)),
                color="#d8b8a4",
                lighting=light,
                hoverinfo="skip",
                name="body",
            ),
            go.Mesh3d(
                **dict(zip("ijk", garment_faces.T.tolist(), strict=True)),
                cmin=0.0,
                cmax=1.0,
                lighting=light,
                colorbar=bar,
                hoverinfo="skip",
                name="garment",
            ),
        ]
    )
    points = np.concatenate((body.reshape(-1, 3), garment.reshape(-1, 3)))[:, [0, 2, 1]] * (1, -1, 1)
    low, high = points.min(0) - 0.05, points.max(0) + 0.05
    titles = ("x [m]", "−z [m]", "height [m]")
    axes = {
        f"{axis}axis": {
            "title": {"text": title, "font": {"size": 11.5, "color": MUTED}},
            "range": [float(low[k]), float(high[k])],
            "backgroundcolor": "white",
            "gridcolor": RULE,
            "zerolinecolor": RULE,
            "tickfont": {"size": 10.5, "color": MUTED},
            "nticks": 5,
            "showspikes": False,
        }
        for k, (axis, title) in enumerate(zip("xyz", titles, strict=True))
    }
    extent = high - low
    ratio = {axis: float(extent[k] / extent.max()) for k, axis in enumerate("xyz")}
    figure.update_layout(
        template="none",
        margin={"l": 0, "r": 40, "t": 0, "b": 0},
        paper_bgcolor="white",
        font={"color": INK, "size": 12, "family": FONT},
        scene={
            **axes,
            "aspectmode": "manual",
            "aspectratio": ratio,
            "camera": {"eye": {"x": 0.7, "y": -1.7, "z": 0.35}},
            "dragmode": "turntable",
        },
        uirevision="one view",
        showlegend=False,
    )
    return figure
