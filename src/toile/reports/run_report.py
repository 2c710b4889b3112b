"""The result page of a run, put together from its folder and its scene."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import pandas as pd
import torch
from torch import Tensor

from toile.evaluation.evaluate import EvaluationResult
from toile.geometry.mesh import grid_faces
from toile.rendering.base import Renderer
from toile.reports.figures import CYCLE
from toile.reports.html import PagePicture, ReportedParameter, ResultPage
from toile.reports.overlay import overlay_picture
from toile.reports.run_folder import (
    RunFolder,
    SavedTrajectory,
    read_config,
    read_git_revision,
    read_history,
    read_metrics,
    read_trajectory,
)
from toile.scenes.scene import Scene


def result_page(run: RunFolder, scene: Scene, renderer: Renderer, n_pictures: int) -> ResultPage:
    """What a run folder and its scene say about the run.

    Args:
        run: only the trajectory has to exist.
        scene: the scene of the run.
        renderer: draws the reconstruction over the video.
        n_pictures: frames to draw, evenly spread from the first to the last.

    Raises:
        InputError: there is no trajectory, or a file cannot be read.
    """
    trajectory = read_trajectory(run)
    history = read_history(run) if run.history.is_file() else None
    columns = [] if history is None else numeric_columns(history)
    losses = [c for c in columns if c.startswith("loss")]
    return ResultPage(
        scene=scene.name,
        positions=trajectory.positions,
        fps=trajectory.fps,
        evaluation=EvaluationResult.from_dict(read_metrics(run)) if run.metrics.is_file() else None,
        ground_truth=true_points(scene, len(trajectory.positions)),
        parameters=reported_parameters(trajectory),
        history=history,
        # The names of the columns carry their units.
        history_units={c: "" for c in columns if c not in (*losses, CYCLE)},
        loss_columns=losses,
        pictures=pictures_over_video(trajectory, scene, renderer, n_pictures),
        facts={"code": read_git_revision(run)} if run.git_revision.is_file() else {},
        config=read_config(run) if run.config.is_file() else "",
    )


def numeric_columns(history: pd.DataFrame) -> list[str]:
    """Columns that can be drawn."""
    return [str(c) for c in history.columns if pd.api.types.is_numeric_dtype(history[c])]


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


def reported_parameters(trajectory: SavedTrajectory) -> list[ReportedParameter]:
    """Saved parameters that fit into a line: numbers, text and short vectors."""
    shown = []
    for name, values in trajectory.parameters.items():
        if values.size == 1:
            value = values.item()
            shown.append(ReportedParameter(name, value if isinstance(value, str) else float(value)))
        elif values.size <= 4 and values.dtype.kind in "biuf":
            shown.append(ReportedParameter(name, ", ".join(f"{v:.4g}" for v in values.ravel())))
    return shown


def pictures_over_video(
    trajectory: SavedTrajectory, scene: Scene, renderer: Renderer, n_pictures: int
) -> list[PagePicture]:
    """Observed, rendered, difference and wireframe at a few frames."""
    n = min(len(trajectory.positions), scene.n_frames)
    chosen = np.unique(np.linspace(0, n - 1, min(n, n_pictures)).round().astype(int)).tolist()
    faces, uv = grid_faces(*scene.grid), scene.texture_coordinates.reshape(-1, 2).float()
    pictures = []
    for frame in chosen:
        x = torch.from_numpy(trajectory.positions[frame])
        with torch.no_grad():
            image = renderer.render(x.reshape(1, -1, 3).float(), faces, uv, scene.texture, scene.camera)
        pixels = overlay_picture(scene.frames[frame], scene.masks[frame], image.rgb[0], x, scene.camera)
        pictures.append(PagePicture(f"Frame {frame}", pixels))
    return pictures
