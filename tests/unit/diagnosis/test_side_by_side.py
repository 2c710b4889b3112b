"""Windows that are simulated as one batch move as each does alone, to the last digit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.unit.diagnosis.test_joint_fit import (
    FRAMES,
    GRAVITY,
    GRID,
    HORIZONTAL,
    STIFFNESS,
    SUBSTEPS,
    WINDS,
    clip,
)
from toile.diagnosis.base_fit import base_of, simulated_windows
from toile.diagnosis.joint_fit import tracked_windows
from toile.diagnosis.shooting import Shooting
from toile.effects.catalogue import CATALOGUE


@pytest.mark.parametrize(
    "acting",
    [
        {},
        {"internal_damping": {"in_plane": 0.02, "bending": 0.2}},
        {"air_drag": {"normal": 1.0}, "gusts": {"x_1": 0.5}, "frame_rate": {"log_factor": 0.05}},
    ],
)
def test_a_batch_moves_as_each_of_it_alone(acting: dict[str, dict[str, float]]) -> None:
    own, around = clip(WINDS[0], ())
    # Two windows of five frames and one of two.
    settings = replace(own.settings, window=5)
    shooting = Shooting(
        own.simulator, SUBSTEPS, GRAVITY, HORIZONTAL, GRID, own.boundary, own.tracked, settings
    )
    windows = tracked_windows(shooting, FRAMES)
    assert {window.last - window.first for window in windows} == {5, 2}
    base = base_of(1.3 * STIFFNESS, np.array([0.1, -0.2, 0.0, 0.1, 0.2]))
    rng = np.random.default_rng(0)
    unknowns = [0.3 * rng.standard_normal(len(window.standardised)) for window in windows]
    given = shooting.with_effects([CATALOGUE[n](v) for n, v in acting.items()], around, base)
    together = simulated_windows(shooting, windows, unknowns, base, given)
    for window, local, found in zip(windows, unknowns, together, strict=True):
        alone = shooting.simulate(window, local, base, given)
        assert np.array_equal(found.positions, alone.positions)
        assert found.start is not None
        assert found.end is not None
        assert alone.end is not None
        assert found.start.positions.shape == found.end.positions.shape == (1, GRID[0] * GRID[1], 3)
        for part in ("positions", "velocities", "past"):
            assert torch.equal(getattr(found.end, part), getattr(alone.end, part))
        assert (found.converged, found.slower) == (alone.converged, alone.slower)
        assert np.abs(found.positions - window.positions).max() > 1e-4
