"""Fits of clips whose frames are unevenly spaced, cut out of a fine clip with a constant rate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from toile.diagnosis.diagnose import diagnose
from toile.diagnosis.settings import DiagnosisSettings
from toile.effects.frame_rate import FrameRate
from toile.errors import InputError
from toile.physics.frame_steps import FrameSteps
from toile.physics.implicit.integrators import BDF2
from toile.physics.implicit.newton import NewtonSettings
from toile.physics.implicit.simulator import ImplicitSimulator
from toile.reconstruction.effects import FitEffects
from toile.reconstruction.fitted_motion import residual_force
from toile.reconstruction.gauss_newton.recipe import SlidingWindows, TrackingRecipe, TrackingStage
from toile.reconstruction.gauss_newton.unknowns import Priors, WindowUnknowns
from toile.reconstruction.gauss_newton.window import minimise_window, state_at
from toile.reconstruction.image_terms.texture_points import PointTermSettings
from toile.reconstruction.image_terms.tracked_positions import PositionTermSettings, TrackedPositionTerm
from toile.reconstruction.parameters import ClothParameters
from toile.reconstruction.problem import Reconstruction
from toile.reconstruction.scene_cloth import scene_cloth, scene_units, template
from toile.rendering import WarpRenderer
from toile.scenes.scene import Scene

FINE = 0.01
"""Time between the frames of the fine clip [s]."""
CHOSEN = (0, 1, 2, 3, 4, 5, 9, 13, 17, 21)
"""Frames of the fine clip that are in the uneven one: 10 ms, then 40 ms."""
TIMES = FINE * torch.tensor(CHOSEN, dtype=torch.float64)
MEAN_FPS = (len(CHOSEN) - 1) / float(TIMES[-1])
WIND = (0.6, 0.0, 2.0)

Make = Callable[..., Reconstruction]


@pytest.fixture
def make(swaying_scene: Scene) -> Make:
    """Makes the problem of the swaying cloth with other frames; their pictures play no part."""

    def problem(
        n_frames: int, fps: float, substeps: int | FrameSteps, times: torch.Tensor | None = None
    ) -> Reconstruction:
        pick = torch.arange(n_frames) % swaying_scene.n_frames
        scene = replace(
            swaying_scene,
            frames=swaying_scene.frames[pick],
            masks=swaying_scene.masks[pick],
            fps=fps,
            times=times,
            ground_truth=None,
        )
        cloth = scene_cloth(scene, 0.15, template)
        parameters = ClothParameters(
            n_frames,
            cloth.n_vertices,
            len(cloth.pinned),
            scene_units(scene, 0.15),
            stretching=3000.0,
            shearing=10.0,
            bending=0.5,
        )
        made = Reconstruction(
            scene,
            cloth,
            lambda cloth, step, **more: ImplicitSimulator(cloth, step, BDF2(), NewtonSettings(1e-9), **more),
            substeps,
            parameters,
            WarpRenderer(),
        )
        with torch.no_grad():
            parameters.wind.copy_(torch.tensor(WIND, dtype=torch.float64))
        return made

    return problem


def uneven(make: Make) -> Reconstruction:
    return make(len(CHOSEN), MEAN_FPS, FrameSteps.nearest(TIMES.tolist(), FINE, 1e-3), TIMES)


def move_hands(problem: Reconstruction, times: torch.Tensor) -> None:
    """Pinned vertices at constant speed, so that they are between frames where they are in the fine clip."""
    speed = torch.tensor([0.2, -0.1, 0.3], dtype=torch.float64)
    with torch.no_grad():
        problem.parameters.boundary_motion.copy_((times[:, None, None] * speed).expand(-1, 2, -1))


@torch.no_grad()
def fine_positions(make: Make) -> torch.Tensor:
    fine = make(CHOSEN[-1] + 1, 1 / FINE, 1)
    move_hands(fine, FINE * torch.arange(CHOSEN[-1] + 1, dtype=torch.float64))
    return fine.simulate(fine.scene.n_frames).positions[0][list(CHOSEN)]


def test_the_motion_is_that_of_the_fine_clip(make: Make) -> None:
    true = fine_positions(make)
    problem = uneven(make)
    assert problem.simulator.time_step == pytest.approx(FINE, rel=1e-12)
    move_hands(problem, TIMES)
    with torch.no_grad():
        found = problem.simulate(len(CHOSEN)).positions[0]
    assert float((found - true).norm(dim=-1).max()) < 1e-7
    # The mean frame rate, which is what a file states, gives another motion.
    mean = make(len(CHOSEN), MEAN_FPS, 2)
    move_hands(mean, TIMES)
    with torch.no_grad():
        wrong = mean.simulate(len(CHOSEN)).positions[0]
    assert float((wrong - true).norm(dim=-1).mean()) > 0.005


def test_another_clock_scales_all_intervals(make: Make) -> None:
    """The frame_rate effect; a clip that runs half as fast is that with twice the time between frames."""
    slow = uneven(make)
    slow.effects = FitEffects((FrameRate({"log_factor": float(np.log(1.5))}),))
    again = make(len(CHOSEN), MEAN_FPS / 1.5, slow.frame_steps, 1.5 * TIMES)
    with torch.no_grad():
        assert slow.simulator_of(slow.setting()).time_step == pytest.approx(1.5 * FINE, rel=1e-12)
        a, b = (p.simulate(len(CHOSEN)).positions for p in (slow, again))
    torch.testing.assert_close(a, b, rtol=0, atol=1e-9)


def found_by_a_fit(problem: Reconstruction, tracked: np.ndarray) -> tuple[np.ndarray, float]:
    """Wind [m/s²] and stretching found from positions at the frames."""
    p, last = problem.parameters, problem.scene.n_frames - 1
    with torch.no_grad():
        p.wind.zero_()
        p.stretching.fill_(2000.0)
    unknowns = WindowUnknowns(
        problem,
        Priors(None, 1.0, 2.0, None, 3.0, 1.0, 1.0, walk=False),
        np.array([2000.0, 10.0, 0.5]),
        0,
        last,
    )
    term = TrackedPositionTerm(tracked, PositionTermSettings(1e-5))
    minimise_window(
        problem,
        unknowns,
        term,
        None,
        state_at(problem, None, 0),
        None,
        iterations=12,
        cg_iterations=50,
        cg_tolerance=1e-8,
    )
    return p.wind.detach().numpy(), p.stretching.item()


def test_a_fit_with_the_times_finds_wind_and_stiffness_and_with_the_mean_rate_does_not(make: Make) -> None:
    fine = make(CHOSEN[-1] + 1, 1 / FINE, 1)
    with torch.no_grad():
        tracked = fine.simulate(fine.scene.n_frames).positions[0][list(CHOSEN)].numpy()
    wind, stretching = found_by_a_fit(uneven(make), tracked)
    np.testing.assert_allclose(wind, WIND, atol=1e-3)
    assert stretching == pytest.approx(3000.0, rel=1e-3)
    wrong, _ = found_by_a_fit(make(len(CHOSEN), MEAN_FPS, 2), tracked)
    assert np.abs(wrong - WIND).max() > 0.3


def tracking() -> TrackingRecipe:
    stage = TrackingStage(
        windows=SlidingWindows(3, 1, 1),
        term=PointTermSettings(16, 1.0, None, 4096.0, 50.0),
        priors=Priors(10.0, 1.0, 2.0, 0.01, 3.0, None, None, walk=False),
        iterations=1,
        cg_iterations=10,
        cg_tolerance=1e-2,
        visibility=False,
        settle=False,
        discard_turbulence=False,
    )
    return TrackingRecipe({"track": stage})


def test_sliding_windows_make_one_simulation_and_go_on_from_a_checkpoint(make: Make) -> None:
    problem, recipe = uneven(make), tracking()
    torch.manual_seed(0)
    recipe.start(problem)
    for index in range(6):
        recipe.cycle(problem, index)
    # As a checkpoint does, in another process.
    parameters = {k: v.clone() for k, v in problem.parameters.state_dict().items()}
    state = recipe.state_dict()
    later, continued = uneven(make), tracking()
    later.parameters.load_state_dict(parameters)
    torch.manual_seed(0)
    continued.start(later)
    continued.load_state_dict(state)
    reports = []
    for p, r in ((problem, recipe), (later, continued)):
        for index in range(6, r.n_cycles(p)):
            report = r.cycle(p, index)
        reports.append(report.positions)
    assert torch.equal(*reports)
    assert len(reports[0]) == len(CHOSEN)
    every = recipe.substep_positions()
    assert every is not None
    assert every.shape[1] == CHOSEN[-1] + 1
    # What was tracked is what the stored parameters give on their own, but for where iterations end.
    with torch.no_grad():
        again = problem.simulate(len(CHOSEN), every)
    torch.testing.assert_close(again.positions[0], reports[0], rtol=0, atol=1e-7)


def test_the_residual_force_knows_the_intervals(make: Make) -> None:
    """Of a simulated motion it is what the differences leave over; with the mean rate it is more."""
    shape = (len(CHOSEN), 8, 8, 3)
    problem, mean = uneven(make), make(len(CHOSEN), MEAN_FPS, 2)
    with torch.no_grad():
        motion = problem.simulate(len(CHOSEN)).positions[0].reshape(shape)
    right, wrong = residual_force(problem, motion), residual_force(mean, motion)
    assert right is not None
    assert wrong is not None
    # Measured where the interval changes: 0.13 and 0.78 of the weight.
    change = CHOSEN.index(5)
    assert right.per_frame[change] < 0.25 * wrong.per_frame[change]


def test_a_number_per_frame_means_nothing_for_uneven_frames(make: Make) -> None:
    with pytest.raises(ValueError, match="FrameSteps"):
        make(len(CHOSEN), MEAN_FPS, 2, TIMES)


def test_a_diagnosis_refuses_uneven_frames(make: Make, tmp_path) -> None:
    with pytest.raises(InputError, match="evenly spaced") as caught:
        diagnose(uneven(make), tracking(), [], DiagnosisSettings(), tmp_path, lambda *_: None)
    assert "times=uniform" in caught.value.expected
    assert "10 to 40 ms" in caught.value.got
