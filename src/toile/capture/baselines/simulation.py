"""Pure simulation on predicted bodies: what there is to know without looking at the garment.

The control for a network that ignores its image: a garment that is as physical as one likes and has nothing
to do with the picture. Whoever claims to have seen the garment must be nearer to it where it is visible.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from toile.capture.layer.layer import Motion, SimulationLayer
from toile.capture.test_time.resolution import CollisionResolution


def simulated(
    layer: SimulationLayer,
    resolution: CollisionResolution,
    bodies: Tensor,
    first: Tensor,
    fps: float,
    substeps: int = 4,
) -> Motion:
    """Simulate the garment on the bodies of a prediction.

    Args:
        layer: of the garment.
        resolution: takes the start out of the body.
        bodies: (F, V, 3) [m] in the world, smoothed.
        first: garment at frame 0 (N, 3) [m], e.g. skinned; it starts without velocity.
        fps: frames per second.
        substeps: steps per frame.

    Raises:
        InputError: shapes that do not fit, or a start that cannot be freed from the body.
        SimulationError: positions are no longer finite.
    """
    begin = resolution(first.numpy()[None], bodies[:1].numpy()).positions[0]
    return layer.simulate(bodies, fps, substeps, start=torch.from_numpy(np.ascontiguousarray(begin)))
