"""What becomes of a cloth's apparent size while what holds it stands still."""

from __future__ import annotations

import numpy as np
import pytest

from toile.diagnosis.apparent_size import seen_change

AT = np.array([[-0.2, -0.1, 1.3], [0.25, -0.1, 1.4]])
SHARE = np.linspace(0, 0.08, 60)[:, None, None]


def test_a_cloth_that_shrinks_seems_to_move_away() -> None:
    # Angles of a cloth whose sides are shorter by a share, seen as one of the old length farther away.
    seen = AT / (1 - SHARE)
    assert seen_change(seen, AT) == pytest.approx(-0.08 * 47 / 59, rel=0.05)
    assert seen_change(AT / (1 + SHARE), AT) == pytest.approx(0.08 * 47 / 59, rel=0.05)


def test_what_one_holder_does_alone_says_nothing() -> None:
    slipping = np.repeat(AT[None], 60, 0)
    slipping[:, 0] *= 1 + SHARE[:, 0]
    assert abs(seen_change(slipping, AT)) < 1e-12
    turning = AT * (1 + SHARE * np.array([[1.0], [-1.0]]))
    assert seen_change(turning, AT) == 0.0


def test_holders_that_all_slip_are_no_cloth_that_shrinks() -> None:
    """They move across the line of sight as well, which a cloth that shrinks does not make them do."""
    slip = np.array([0.03, 0.0, 0.05]) * np.linspace(0, 1, 60)[:, None, None]
    assert seen_change(AT + slip, AT) == 0.0
    straight = slip * np.array([0.1, 0.0, 1.0])
    assert seen_change(AT + straight, AT) < -0.01


def test_a_wrong_distance_from_the_first_frame_on_says_nothing() -> None:
    # As of a focal length that is not what it is said to be.
    assert seen_change(np.repeat(1.05 * AT[None], 60, 0), AT) == pytest.approx(0.0, abs=1e-12)


def test_motion_across_the_line_of_sight_says_nothing() -> None:
    across = np.cross(AT, [0.0, 0.0, 1.0])
    assert abs(seen_change(AT + SHARE * across, AT)) < 1e-12
