"""What a fit leaves in its run folder."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from torch import Tensor

from toile.cli.machine import machine
from toile.evaluation.evaluate import EvaluationResult
from toile.learning.fit.module import FitModule
from toile.reconstruction.fitted_motion import (
    cold_trajectory,
    fitted_parameters,
    fitted_scene,
    largest_distance,
    rendered_frames,
)
from toile.reports.figures import (
    error_over_frames,
    loss_curves,
    parameter_histories,
    save_figure,
    side_view,
)
from toile.reports.overlay import overlay_pictures, write_video
from toile.reports.page.run_page import write_result_page
from toile.reports.run_folder import RunFolder, write_history, write_metrics, write_trajectory
from toile.reports.run_report import result_page, true_points
from toile.scenes.validation import uncropped_camera

_SIDE_VIEWS = 4


class Seconds(NamedTuple):
    """How long a fit took.

    Attributes:
        cycles: all cycles of all tries.
        command: the command so far.
        processor: of the processor in those cycles; NaN where that is not known.
    """

    cycles: float
    command: float
    processor: float


def write_motion(folder: RunFolder, module: FitModule, trajectory: Tensor) -> None:
    """Write history.csv and trajectory.npz: what a run must have to be of use."""
    write_history(folder, pd.DataFrame(module.history))
    reconstruction = module.reconstruction
    scene = reconstruction.scene
    camera = uncropped_camera(scene)
    write_trajectory(
        folder,
        trajectory.numpy(),
        fps=scene.fps,
        times=scene.times,
        parameters=fitted_parameters(reconstruction),
        faces=reconstruction.faces.numpy(),
        intrinsics=[[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]],
        image_size=(camera.height, camera.width),
        gravity=scene.gravity.numpy(),
    )


def write_numbers(
    folder: RunFolder,
    module: FitModule,
    trajectory: Tensor,
    evaluation: EvaluationResult,
    seconds: Seconds,
    warnings: Sequence[str] = (),
) -> None:
    """Write metrics.json.

    Args:
        folder: where to.
        module: after the fit.
        trajectory: final one (F, H, W, 3) [m].
        evaluation: of that trajectory.
        seconds: how long it took.
        warnings: what is remarkable about the scene or the fit, for the page.
    """
    cold = cold_trajectory(module.reconstruction)
    numbers: dict[str, Any] = {
        **evaluation.to_dict(),
        "fit": {
            "cycles": module.cycles_done,
            "seconds of the fit": seconds.cycles,
            "processor seconds of the fit": None if math.isnan(seconds.processor) else seconds.processor,
            "seconds in total": seconds.command,
            "last losses": {k: v for k, v in module.history[-1].items() if k.startswith("loss")}
            if module.history
            else {},
            # Only a fit knows the forces; an evaluation of fewer frames must not lose it.
            "out_of_balance": evaluation.to_dict()["metrics"].get("out_of_balance"),
            "difference to the last cycle [mm]": None
            if module.report is None
            else 1e3 * largest_distance(trajectory, module.report.positions),
            "difference to a rollout without warm start [mm]": None
            if cold is None
            else 1e3 * largest_distance(trajectory, cold),
        },
        "machine": machine(),
        "scene warnings": list(warnings),
    }
    write_metrics(folder, numbers)


def last_picture(folder: RunFolder, report: Any) -> Path | None:
    """What ``write_pictures`` writes last; None if it writes nothing."""
    return folder.page if report.page else folder.overlay_video if report.video else None


def write_pictures(
    folder: RunFolder, module: FitModule, trajectory: Tensor, evaluation: EvaluationResult, report: Any
) -> None:
    """Write overlay.mp4, figures and index.html; ``report`` says which, as in the configuration."""
    reconstruction = module.reconstruction
    scene = fitted_scene(reconstruction)
    if report.video:
        pictures = overlay_pictures(
            scene.frames,
            scene.masks,
            rendered_frames(reconstruction, scene, trajectory),
            trajectory,
            scene.camera,
        )
        write_video(pictures, folder.overlay_video, scene.fps)
    if not report.page:
        return
    history = pd.DataFrame(module.history)
    if any(np.isfinite(m.mean) for m in evaluation.metrics.values()):
        save_figure(error_over_frames(evaluation), folder.figures / "errors.png")
    if len(history):
        units = [c for c in history.columns if c.endswith("]")]
        save_figure(parameter_histories(history, dict.fromkeys(units, "")), folder.figures / "parameters.png")
        save_figure(loss_curves(history), folder.figures / "losses.png")
    n = scene.n_frames
    frames = np.unique(np.linspace(0, n - 1, min(n, _SIDE_VIEWS)).round().astype(int)).tolist()
    view = side_view(trajectory.numpy(), frames, true_points(scene, n))
    save_figure(view, folder.figures / "side_view.png")
    page = result_page(folder, scene, reconstruction.renderer, report.pictures)
    write_result_page(page, folder.page)
