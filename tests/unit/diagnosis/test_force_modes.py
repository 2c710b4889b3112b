"""Which missing forces the balance of torques about the holders sees."""

from __future__ import annotations

import numpy as np
import pytest

from toile.diagnosis.force_modes import external_first, n_balanced

LINE = np.array([[0.0, 0.0, 1.0], [0.5, 0.02, 1.1]])


@pytest.mark.parametrize(("pinned", "expected"), [(0, 6), (1, 3), (2, 1)])
def test_free_directions_of_holders(pinned: int, expected: int) -> None:
    assert n_balanced(LINE[:pinned], 0.5) == expected


def test_three_corners_leave_nothing_free() -> None:
    pinned = np.concatenate((LINE, [[0.25, 0.5, 1.0]]))
    assert n_balanced(pinned, 0.5) == 0


def modes(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    positions = rng.uniform(-0.3, 0.3, (40, 3)) + np.array([0.25, 0.3, 1.0])
    positions[:2] = LINE
    fields = rng.normal(size=(12, 40, 3))
    fields[:, :2] = 0
    return fields, rng.uniform(0.5, 1.5, 40), positions


def test_all_but_the_first_leave_the_torque_about_the_line_alone() -> None:
    fields, masses, positions = modes(0)
    turned = external_first(fields, masses, positions, LINE, 1)
    assert turned @ turned.T == pytest.approx(np.eye(12), abs=1e-12)
    forces = np.tensordot(turned, fields, 1) * masses[:, None]
    axis = (LINE[1] - LINE[0]) / np.linalg.norm(LINE[1] - LINE[0])
    torque = np.cross(positions - LINE[0], forces).sum(1) @ axis
    assert abs(torque[0]) > 0.1
    assert torque[1:] == pytest.approx(0, abs=1e-10)


def test_what_the_cloth_does_to_itself_disturbs_nothing() -> None:
    """A pair of opposite forces along the line between two vertices has no external part."""
    fields, masses, positions = modes(1)
    pair = np.zeros((40, 3))
    along = positions[7] - positions[11]
    pair[7], pair[11] = along / masses[7], -along / masses[11]
    turned = external_first(np.concatenate((fields, pair[None])), masses, positions, LINE, 1)
    assert turned[0, -1] == pytest.approx(0, abs=1e-12)


def test_what_counts_as_held_is_a_setting() -> None:
    # Holders a hundredth of the cloth apart hardly resist a torque about the other two axes.
    near = np.array([[0.0, 0.0, 1.0], [0.005, 0.0, 1.0]])
    assert n_balanced(near, 0.5) == 3
    assert n_balanced(near, 0.5, tolerance=0.001) == 1
