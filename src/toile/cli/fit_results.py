"""What a fit leaves in its run folder."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pandas as pd
import torch
from torch import Tensor

from toile.cli.machine import machine
from toile.evaluation.evaluate import EvaluationResult
from toile.evaluation.out_of_balance import OutOfBalanceForce, out_of_balance_force
from toile.learning.fit.module import FitModule
from toile.physics.implicit.terms import term_forces
from toile.physics.simulator import SimulationError
from toile.physics.step_terms import ElementTerm, StepContext
from toile.reconstruction.problem import Reconstruction
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
from toile.scenes.scene import Scene
from toile.scenes.validation import uncropped_camera

_SIDE_VIEWS = 4


class Seconds(NamedTuple):
    """How long a fit took.

    Attributes:
        cycles: all cycles of all tries.
        command: the command so far.
    """

    cycles: float
    command: float


@torch.no_grad()
def final_trajectory(reconstruction: Reconstruction, substep_positions: Tensor | None) -> Tensor:
    """The whole video simulated once more from the fitted parameters, (F, H, W, 3) [m].

    Args:
        reconstruction: with the fitted parameters.
        substep_positions: where every step starts its iterations, see Recipe.substep_positions; None starts
            from the past alone, and then a buckling cloth may settle in another equilibrium.

    Raises:
        SimulationError: a step did not converge.
    """
    scene = reconstruction.scene
    motion = reconstruction.simulate(scene.n_frames, substep_positions)
    return motion.positions[0].reshape(scene.n_frames, *scene.grid, 3)


@torch.no_grad()
def residual_force(reconstruction: Reconstruction, trajectory: Tensor) -> OutOfBalanceForce | None:
    """Out-of-balance force of the trajectory under the fitted forces and effects.

    None for fewer than three frames. Effects within a step act as in a sub-step that ends in the frame with
    the velocity between the frames beside it. Frames count as being where they were simulated.
    """
    scene, given = reconstruction.scene, reconstruction.setting()
    cloth, interval = given.cloth, float(given.frame_interval)
    if scene.n_frames < 3 or not bool(scene.gravity.any()):
        return None
    step = interval / reconstruction.frame_steps.per_frame
    regular = torch.arange(scene.n_frames, dtype=torch.float64) * interval
    times = regular if scene.times is None else reconstruction.frame_steps.times(step)
    material = reconstruction.parameters.material()
    elastic = not any(isinstance(term, ElementTerm) for term in given.terms)

    def internal_forces(positions: Tensor) -> Tensor:
        with torch.enable_grad():
            x = positions.reshape(len(positions), -1, 3).clone().requires_grad_()
            energy = cloth.energies.energy(x, cloth.energies.coefficients(material.values))
            return -torch.autograd.grad(energy.sum(), x)[0].reshape(positions.shape)

    def with_terms(positions: Tensor) -> Tensor:
        if not given.terms:
            return internal_forces(positions)
        x = trajectory.reshape(scene.n_frames, -1, 3)
        if scene.times is None:
            velocities = (x[2:] - x[:-2]) / (2 * interval)
        else:
            velocities = torch.gradient(x, spacing=(times,), dim=0)[0][1:-1]
        forces = []
        for frame, (at, velocity) in enumerate(zip(x[1:-1], velocities, strict=True), 1):
            now = StepContext(
                cloth, material, at - step * velocity, velocity, float(times[frame]), step, at[cloth.pinned]
            )
            # Where terms change the elements, this is the elastic force, too.
            forces.append(term_forces(given.terms, now, at).detach())
        found = torch.stack(forces).reshape(positions.shape)
        return found + internal_forces(positions) if elastic else found

    # Forces entry t acts on frame t + 1; the inner frames are 1 ... F - 2.
    forces = reconstruction.forces(given, 0, scene.n_frames - 2)
    return out_of_balance_force(
        trajectory,
        masses=cloth.masses.reshape(scene.grid),
        internal_forces=with_terms,
        external_forces=forces.reshape(-1, *scene.grid, 3),
        frame_time=interval if scene.times is None else times.diff(),
        gravity=scene.gravity,
        pinned_vertices=scene.pinned_vertices,
    )


def fitted_parameters(reconstruction: Reconstruction) -> dict[str, npt.ArrayLike]:
    """Everything that was fitted, by name and unit, for trajectory.npz."""
    p, grid = reconstruction.parameters, reconstruction.scene.grid
    material = p.material()
    result: dict[str, npt.ArrayLike] = {
        parameter.label: value
        for parameter, value in zip(material.parameters, material.values[0].tolist(), strict=True)
    }
    for name in p.STIFFNESSES:
        result[f"{name} [network units]"] = p.get_parameter(name).item()
    result.update(reconstruction.effects.numbers())
    result["wind [m/s²]"] = p.wind.detach().numpy()
    result["turbulence [m/s²]"] = p.turbulence.detach().numpy().reshape(-1, *grid, 3)
    result["boundary motion [m]"] = p.boundary_motion.detach().numpy()
    result["pinned vertices"] = reconstruction.cloth.pinned.numpy()
    result["texture offset"] = p.texture_offset.detach().numpy().reshape(*grid, 2)
    with torch.no_grad():
        result["masses [kg]"] = reconstruction.setting().cloth.masses.numpy().reshape(grid)
    result["rest lengths [m]"] = reconstruction.cloth.rest_lengths.numpy()
    return result


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
    numbers: dict[str, Any] = {
        **evaluation.to_dict(),
        "fit": {
            "cycles": module.cycles_done,
            "seconds of the fit": seconds.cycles,
            "seconds in total": seconds.command,
            "last losses": {k: v for k, v in module.history[-1].items() if k.startswith("loss")}
            if module.history
            else {},
            # Only a fit knows the forces; an evaluation of fewer frames must not lose it.
            "out_of_balance": evaluation.to_dict()["metrics"].get("out_of_balance"),
            "difference to the last cycle [mm]": _difference(module, trajectory),
            "difference to a rollout without warm start [mm]": _difference_cold(module, trajectory),
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
    scene = textured(reconstruction)
    if report.video:
        pictures = overlay_pictures(
            scene.frames, scene.masks, _drawn(reconstruction, scene, trajectory), trajectory, scene.camera
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


def textured(reconstruction: Reconstruction) -> Scene:
    """The scene with its texture coordinates as fitted."""
    scene = reconstruction.scene
    offset = reconstruction.parameters.texture_offset.detach().float().reshape(*scene.grid, 2)
    return dataclasses.replace(scene, texture_coordinates=scene.texture_coordinates + offset)


@torch.no_grad()
def _drawn(reconstruction: Reconstruction, scene: Scene, trajectory: Tensor) -> Iterator[Tensor]:
    uv = scene.texture_coordinates.reshape(-1, 2)
    for x in trajectory.reshape(scene.n_frames, 1, -1, 3):
        images = reconstruction.renderer.render(x, reconstruction.faces, uv, scene.texture, scene.camera)
        yield images.rgb[0]


def _difference(module: FitModule, trajectory: Tensor) -> float | None:
    """Largest distance [mm] between the final trajectory and the motion that the last cycle saw."""
    if module.report is None:
        return None
    seen = module.report.positions
    return 1e3 * float((trajectory[: len(seen)].reshape(seen.shape) - seen).norm(dim=-1).max())


def _difference_cold(module: FitModule, trajectory: Tensor) -> float | None:
    """Largest distance [mm] to the motion that the parameters give on their own; None where that fails."""
    try:
        cold = final_trajectory(module.reconstruction, None)
    except SimulationError:
        return None
    return 1e3 * float((trajectory - cold).norm(dim=-1).max())
