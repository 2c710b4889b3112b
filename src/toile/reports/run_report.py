"""The result page of a run, put together from its folder and its scene."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd
import torch
from PIL import Image
from torch import Tensor

from toile.errors import InputError
from toile.evaluation.evaluate import EvaluationResult
from toile.geometry.mesh import grid_faces
from toile.rendering.base import Renderer
from toile.rendering.visibility import visible_points
from toile.reports.cloth_fields import colour_residual, error_field, force_field, residual_field
from toile.reports.figures import CYCLE
from toile.reports.overlay import difference, overlay_picture
from toile.reports.page.run_page import PagePicture, ReportedParameter, ResultPage
from toile.reports.page.viewer import Video
from toile.reports.run_folder import (
    RunFolder,
    SavedTrajectory,
    read_config,
    read_git_revision,
    read_history,
    read_metrics,
    read_trajectory,
)
from toile.reports.run_settings import read_settings
from toile.reports.stiffness_note import stiffness_note
from toile.scenes.scene import Scene

SCENE_WARNINGS = "scene warnings"
"""Key of metrics.json: what a check of the scene found, a list of sentences."""
OBSERVED_SIZE, OTHER_SIZE = 520, 430
"""Longer side of the video's pictures in the page [px]; what is rendered has less detail to lose."""
MAX_FRAMES_OF_ALL_VIEWS = 120
"""Frames up to which every view of the video is kept; a longer video is shown as observed only."""


def result_page(run: RunFolder, scene: Scene, renderer: Renderer, n_pictures: int) -> ResultPage:
    """What a run folder and its scene say about the run.

    Args:
        run: only the trajectory has to exist.
        scene: the scene of the run.
        renderer: draws the reconstruction over the video.
        n_pictures: frames to draw side by side, evenly spread from the first to the last.

    Raises:
        InputError: there is no trajectory, or a file cannot be read.
    """
    trajectory = read_trajectory(run)
    positions = trajectory.positions
    history = read_history(run) if run.history.is_file() else None
    columns = [] if history is None else numeric_columns(history)
    losses = [c for c in columns if c.startswith("loss")]
    if "loss per frame" in losses:
        # A sum over a window of frames grows with the window, which is no divergence.
        losses.remove("loss")
    metrics = read_metrics(run) if run.metrics.is_file() else {}
    config = read_config(run) if run.config.is_file() else ""
    drawn = Drawn(trajectory, scene, renderer, n_pictures)
    return ResultPage(
        scene=scene.name,
        positions=positions,
        fps=trajectory.fps,
        times=trajectory.uneven_times,
        evaluation=EvaluationResult.from_dict(metrics) if metrics else None,
        ground_truth=true_points(scene, len(positions)),
        error=error_field(positions, scene.ground_truth) or residual_field(drawn.residual),
        force=force_field(trajectory.parameters, len(positions)),
        pinned=pinned_vertices(scene),
        video=drawn.video,
        parameters=reported_parameters(trajectory),
        history=history,
        # What is fitted carries its unit in its name; the other columns count work.
        history_units={c: "" for c in columns if c.endswith("]")},
        loss_columns=losses,
        pictures=drawn.pictures,
        facts=reported_facts(run, metrics),
        warnings=scene_warnings(metrics, run),
        stiffness_note=stiffness_note(read_settings(config, str(run.config))) if config else "",
        config=config,
    )


def numeric_columns(history: pd.DataFrame) -> list[str]:
    """Columns that can be drawn."""
    return [str(c) for c in history.columns if c != CYCLE and pd.api.types.is_numeric_dtype(history[c])]


def true_points(scene: Scene, n_frames: int) -> Sequence[npt.NDArray[np.floating]] | None:
    """Ground-truth points (N_f, 3) [m] of every reconstructed frame, or None."""
    truth = scene.ground_truth
    points: Sequence[Tensor] | None = None
    if truth is not None:
        points = truth.point_clouds
        if points is None and truth.vertices is not None:
            points = [v.reshape(-1, 3) for v in truth.vertices]
    if points is None or len(points) < n_frames:
        return None
    return [p.numpy() for p in points[:n_frames]]


def pinned_vertices(scene: Scene) -> npt.NDArray[np.bool_]:
    """Which vertices of the grid are pinned (H, W)."""
    pinned = np.zeros(scene.grid[0] * scene.grid[1], dtype=bool)
    pinned[list(scene.pinned_vertices)] = True
    return pinned.reshape(scene.grid)


def reported_parameters(trajectory: SavedTrajectory) -> list[ReportedParameter]:
    """Saved parameters that fit into a line: numbers, text and short vectors, other than indices."""
    shown = []
    for saved_as, values in trajectory.parameters.items():
        name, unit = _name_and_unit(saved_as)
        if values.size == 1:
            value = values.item()
            shown.append(ReportedParameter(name, value if isinstance(value, str) else float(value), unit))
        elif values.size <= 4 and values.dtype.kind == "f":
            text = ", ".join(f"{v:.3g}" for v in values.ravel()).replace("-", "−")
            shown.append(ReportedParameter(name, text, unit))
    return shown


def reported_facts(run: RunFolder, metrics: Mapping[str, Any]) -> dict[str, str]:
    """Where, when and with what a run was made, as far as it is noted."""
    facts = {}
    fit, machine = metrics.get("fit"), metrics.get("machine")
    if isinstance(fit, Mapping):
        for name in ("cycles", "seconds of the fit", "processor seconds of the fit", "seconds in total"):
            value = fit.get(name)
            if isinstance(value, int | float):
                facts[name] = f"{value:.3g}" if isinstance(value, float) else str(value)
    if isinstance(machine, Mapping):
        facts["machine"] = ", ".join(f"{key} {value}" for key, value in machine.items())
    if run.git_revision.is_file():
        facts["revision of the code"] = read_git_revision(run)
    return facts


def scene_warnings(metrics: Mapping[str, Any], run: RunFolder) -> list[str]:
    """What was found in the scene when it was fitted; none where nothing is noted.

    Raises:
        InputError: something else than a list of sentences stands there.
    """
    found = metrics.get(SCENE_WARNINGS, [])
    if not isinstance(found, list) or not all(isinstance(line, str) for line in found):
        raise InputError(
            "A file of the run cannot be read",
            where=f"{run.metrics}: {SCENE_WARNINGS}",
            expected="a list of sentences",
            got=repr(found)[:80],
        )
    return found


class Drawn:
    """The reconstruction drawn once over every frame of its video.

    Attributes:
        video: observed, rendered and difference of every frame.
        pictures: overlay pictures of a few frames.
        residual: (F, H, W) colour difference at the vertices in [0, 1]; NaN where hidden or without a frame.
    """

    @torch.no_grad()
    def __init__(
        self, trajectory: SavedTrajectory, scene: Scene, renderer: Renderer, n_pictures: int
    ) -> None:
        n = min(len(trajectory.positions), scene.n_frames)
        chosen = set(np.linspace(0, n - 1, min(n, n_pictures)).round().astype(int).tolist())
        faces, uv = grid_faces(*scene.grid), scene.texture_coordinates.reshape(-1, 2).float()
        corner, weights = _vertices_on_faces(faces, scene.grid[0] * scene.grid[1])
        views: dict[str, list[npt.NDArray[np.uint8]]] = {"observed": [], "rendered": [], "difference": []}
        self.pictures: list[PagePicture] = []
        self.residual = np.full(trajectory.positions.shape[:3], np.nan)
        for f in range(n):
            x = torch.from_numpy(trajectory.positions[f])
            vertices = x.reshape(1, -1, 3).float()
            image = renderer.render(vertices, faces, uv, scene.texture, scene.camera).rgb[0]
            frame, mask = scene.frames[f], scene.masks[f]
            if scene.ground_truth is None:
                fragments = renderer.rasterize(vertices, faces, scene.camera)
                seen = visible_points(fragments, vertices, faces, scene.camera, corner, weights)
                self.residual[f] = colour_residual(
                    frame, mask, image, x, seen[0].reshape(scene.grid), scene.camera
                )
            views["observed"].append(_small(frame, OBSERVED_SIZE))
            if n <= MAX_FRAMES_OF_ALL_VIEWS:
                views["rendered"].append(_small(image, OTHER_SIZE))
                views["difference"].append(_small(difference(frame, mask, image), OTHER_SIZE))
            if f in chosen:
                pixels = overlay_picture(frame, mask, image, x, scene.camera, caption=f"frame {f}")
                caption = f"Frame {f}: observed, rendered, difference, mesh"
                self.pictures.append(PagePicture(caption, pixels))
        # A trajectory longer than its video keeps the last picture.
        missing = len(trajectory.positions) - n
        shown = {name: [*frames, *frames[-1:] * missing] for name, frames in views.items() if frames}
        self.video = Video(scene.camera, shown)


def _vertices_on_faces(faces: Tensor, n_vertices: int) -> tuple[Tensor, Tensor]:
    """For every vertex a face it belongs to (V,) and its barycentric coordinates there (V, 3)."""
    face = torch.zeros(n_vertices, dtype=torch.long)
    weights = torch.zeros(n_vertices, 3)
    numbers = torch.arange(len(faces))
    for corner in range(3):
        at = faces[:, corner]
        face[at] = numbers
        weights[at] = torch.eye(3)[corner]
    return face, weights


def _small(image: Tensor | npt.NDArray[np.uint8], size: int) -> npt.NDArray[np.uint8]:
    """An image (h, w, 3) as uint8, its longer side at most that many pixels."""
    if isinstance(image, Tensor):
        image = (image.detach().cpu().float().clamp(0, 1) * 255).round().byte().numpy()
    picture = Image.fromarray(image)
    picture.thumbnail((size, size), Image.Resampling.LANCZOS)
    return np.asarray(picture)


def _name_and_unit(saved_as: str) -> tuple[str, str]:
    """("stretching", "N/m") from "stretching [N/m]"."""
    found = re.fullmatch(r"(.*\S)\s*\[(.+)\]", saved_as)
    return (found[1], found[2]) if found else (saved_as, "")
