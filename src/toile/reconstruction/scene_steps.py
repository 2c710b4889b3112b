"""From a scene to the sub-steps between its frames."""

from __future__ import annotations

import logging

from toile.errors import InputError
from toile.physics.frame_steps import FrameSteps, fewest_substeps
from toile.scenes.scene import Scene

log = logging.getLogger(__name__)


def scene_frame_steps(
    scene: Scene, substeps: int | None, longest_substep: float, largest_time_error: float
) -> FrameSteps:
    """The number asked for, or as few as keep a sub-step within the longest one, every frame in its time.

    Args:
        scene: its frame rate, or the times of its frames, are used.
        substeps: per frame; None for as few as possible.
        longest_substep: [s].
        largest_time_error: by which a frame may be off where they are unevenly spaced [s].

    Raises:
        InputError: a number per frame is asked for, and the frames are unevenly spaced.
    """
    if scene.times is None:
        if substeps is None:
            substeps = fewest_substeps(1 / scene.fps, longest_substep)
        return FrameSteps.regular(substeps, scene.n_frames)
    intervals = scene.times.diff()
    if substeps is not None:
        raise InputError(
            "A fixed number of sub-steps per frame needs evenly spaced frames",
            where="simulator.substeps",
            expected="substeps=null and a longest_substep [s], because this scene has time stamps",
            got=f"{substeps}, and intervals of {1e3 * float(intervals.min()):.4g} to "
            f"{1e3 * float(intervals.max()):.4g} ms",
        )
    steps = FrameSteps.nearest(scene.times.tolist(), longest_substep, largest_time_error)
    step = 1 / scene.fps / steps.per_frame
    off = float((steps.times(step) - scene.times).abs().max())
    log.info(
        "unevenly spaced frames: %d sub-steps of %.4g ms, frames at most %.3g ms from their times",
        steps.ends[-1],
        1e3 * step,
        1e3 * off,
    )
    return steps
