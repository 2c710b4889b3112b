"""The motion of fitted parameters, and the scene with what was fitted of its texture."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from toile.physics.simulator import SimulationError
from toile.reconstruction.fitted_motion import (
    cold_trajectory,
    final_trajectory,
    fitted_scene,
    largest_distance,
    rendered_frames,
    residual_force,
)
from toile.reconstruction.problem import Reconstruction

Make = Callable[..., Reconstruction]


def test_the_final_trajectory_is_the_simulation_of_the_parameters(problem: Make) -> None:
    made = problem()
    scene = made.scene
    with torch.no_grad():
        motion = made.simulate(scene.n_frames)
    shape = (scene.n_frames, *scene.grid, 3)
    cold = cold_trajectory(made)
    assert cold is not None
    assert cold.shape == shape
    assert torch.equal(cold, motion.positions[0].reshape(shape))
    # Steps that start where they ended before end within the solver's accuracy of there.
    assert largest_distance(cold, final_trajectory(made, motion.all_positions)) < 1e-6


def test_a_motion_that_cannot_be_simulated_is_none(problem: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object) -> None:
        raise SimulationError("no convergence")

    made = problem()
    monkeypatch.setattr(made, "simulate", fails)
    assert cold_trajectory(made) is None
    with pytest.raises(SimulationError):
        final_trajectory(made, None)


def test_simulated_motion_keeps_the_second_law_and_another_does_not(problem: Make) -> None:
    made = problem()
    motion = cold_trajectory(made)
    assert motion is not None
    kept = residual_force(made, motion)
    spoilt = motion.clone()
    spoilt[2] += 0.01 * torch.randn(spoilt[2].shape, generator=torch.Generator().manual_seed(0))
    broken = residual_force(made, spoilt)
    assert kept is not None
    assert broken is not None
    assert broken.per_frame[2] > 10 * kept.per_frame[2]


def test_the_largest_distance_is_that_of_the_first_frames() -> None:
    trajectory = torch.zeros(3, 2, 2, 3, dtype=torch.float64)
    other = torch.zeros(2, 4, 3, dtype=torch.float64)
    other[1, 2] = torch.tensor([0.0, 3.0, 4.0])
    assert largest_distance(trajectory, other) == 5.0


def test_pictures_show_the_texture_where_it_was_fitted(problem: Make) -> None:
    made = problem()
    scene = made.scene
    motion = scene.template[None].repeat(scene.n_frames, 1, 1, 1)
    with torch.no_grad():
        made.parameters.texture_offset += 0.05
    moved = fitted_scene(made)
    torch.testing.assert_close(moved.texture_coordinates, scene.texture_coordinates + 0.05)
    assert moved.texture_coordinates.dtype == scene.texture_coordinates.dtype
    before, after = (next(rendered_frames(made, s, motion)) for s in (scene, moved))
    assert before.shape == after.shape == (*scene.frames.shape[1:3], 3)
    assert not torch.equal(before, after)
