"""Sub-steps of scenes with even and uneven frames."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from toile.errors import InputError
from toile.physics.frame_steps import FrameSteps
from toile.reconstruction.scene_steps import scene_frame_steps
from toile.scenes.scene import Scene


def test_as_few_as_possible_or_as_asked_for(tiny_scene: Scene) -> None:
    scene = replace(tiny_scene, fps=50.0)
    n = scene.n_frames
    assert scene_frame_steps(scene, None, 0.01, 1e-3) == FrameSteps.regular(2, n)
    assert scene_frame_steps(scene, 3, 0.01, 1e-3) == FrameSteps.regular(3, n)


def test_uneven_frames_are_at_their_times(tiny_scene: Scene, caplog: pytest.LogCaptureFixture) -> None:
    ends = [0, 1, *range(5, 5 + 4 * (tiny_scene.n_frames - 2), 4)]
    times = 0.01 * torch.tensor(ends, dtype=torch.float64)
    scene = replace(tiny_scene, times=times, fps=(len(ends) - 1) / float(times[-1]))
    with caplog.at_level("INFO"):
        assert scene_frame_steps(scene, None, 0.01, 1e-3).ends == tuple(ends)
    assert f"{ends[-1]} sub-steps of 10 ms" in caplog.text
    with pytest.raises(InputError, match="evenly spaced frames") as caught:
        scene_frame_steps(scene, 3, 0.01, 1e-3)
    assert "10 to 40 ms" in caught.value.got
