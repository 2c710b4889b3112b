"""All numbers of one clip by name."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from toile.diagnosis.learned.balance_features import balance_features
from toile.diagnosis.learned.fields import Fields
from toile.diagnosis.learned.kinematics import kinematic_features
from toile.diagnosis.learned.motion import observed_motion
from toile.diagnosis.learned.rotation import energy_features, rotation_features

Array = NDArray[np.float64]

VERSION = 1
"""Counts up when a feature changes its meaning: weights belong to one version."""

GROUPS = ("balance", "torque", "energy", "shape", "holders", "modes", "extent", "early", "recording")
"""First parts of the names."""


def clip_features(
    positions: Array,
    pinned: Sequence[int],
    fps: float,
    gravity: Array,
    cloth_size: tuple[float, float],
) -> dict[str, float]:
    """Physical features of a tracked clip; all that is needed is known after tracking.

    Features have no dimension but those of ``recording``: lengths in widths, accelerations in g.

    Args:
        positions: (F, H, W, 3) [m], on any grid of 4 × 4 or more, twelve frames or more.
        pinned: flattened indices of the pinned vertices.
        fps: frames per second.
        gravity: (3,) [m/s²].
        cloth_size: along axis 1 and 0 [m].

    Returns:
        Numbers by name, in a fixed order; nan where one cannot be had.

    Raises:
        InputError: too few frames, no pinned vertex, or positions that are not finite.
    """
    fields = Fields(observed_motion(positions, pinned, fps, gravity, cloth_size))
    features = {
        **balance_features(fields),
        **rotation_features(fields),
        **energy_features(fields),
        **kinematic_features(fields),
    }
    return {name: value if np.isfinite(value) else float("nan") for name, value in features.items()}
