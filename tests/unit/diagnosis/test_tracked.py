"""Windows of the tracking before a diagnosis, and its image term on the model's grid."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from toile.diagnosis.model_grid import model_grid
from toile.diagnosis.tracked import StopAt, tracked_motion
from toile.reconstruction.gauss_newton.recipe import SlidingWindows
from toile.reconstruction.image_terms.texture_points import PointTermSettings, TexturePointTerm
from toile.reconstruction.problem import Reconstruction
from toile.scenes.scene import Scene


def test_one_window_ends_at_the_frame() -> None:
    plan = StopAt(SlidingWindows(6, 2, 1), 9).plan(14)
    assert plan == [(0, 2), (0, 4), (0, 6), (2, 8), (3, 9), (4, 10), (6, 12), (7, 13)]


def test_windows_that_end_there_anyway_stay_as_they_are() -> None:
    windows = SlidingWindows(6, 1, 1)
    assert StopAt(windows, 9).plan(14) == windows.plan(14)


def test_a_clip_that_ends_before_the_frame() -> None:
    windows = SlidingWindows(6, 2, 1)
    assert StopAt(windows, 29).plan(14) == windows.plan(14)


def test_as_many_vertices_on_other_lines_are_another_grid(
    problem: Callable[..., Reconstruction], swaying_scene: Scene
) -> None:
    """Their images are those of the scene's grid seen through the spline between both."""
    reconstruction = problem()
    assert swaying_scene.ground_truth is not None
    x = swaying_scene.ground_truth.vertices.reshape(swaying_scene.n_frames, -1, 3).numpy()
    term = TexturePointTerm.of(reconstruction, PointTermSettings(24, 1.0, 4.0, 1.0, 1.0), 0)
    side = swaying_scene.grid[0]
    own, crowded = (model_grid(swaying_scene, reconstruction.cloth, side, None, c) for c in (0.0, 0.5))
    whole, seen = (tracked_motion(reconstruction, x, grid, term) for grid in (own, crowded))
    spline = np.kron(crowded.prolong, np.eye(3))
    expected = spline.T @ whole.information[2] @ spline
    np.testing.assert_allclose(seen.information[2], expected, rtol=1e-3, atol=1e-4 * np.abs(expected).max())
