"""Horizontal directions of level, tilted and rolled cameras."""

from __future__ import annotations

import math

import pytest
import torch

from toile.errors import InputError
from toile.geometry.horizontal import horizontal_axes


def rolled(angle: float) -> torch.Tensor:
    """Rotation about the optical axis (3, 3)."""
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)


GRAVITIES = [(0.0, 9.81, 0.0), (0.0, 9.7, 0.9), (0.0, 9.0, -3.0), (0.3, 9.7, 1.0)]


def vector(values: tuple[float, ...]) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


@pytest.mark.parametrize("angle", [0, 30, 60, 80, 90, 100, 180, 270])
@pytest.mark.parametrize("gravity", GRAVITIES)
def test_unit_vectors_across_gravity(gravity: tuple[float, ...], angle: float) -> None:
    down = rolled(math.radians(angle)) @ vector(gravity)
    axes = horizontal_axes(down)
    torch.testing.assert_close(axes @ axes.T, torch.eye(2, dtype=torch.float64))
    torch.testing.assert_close(axes @ down, torch.zeros(2, dtype=torch.float64), atol=1e-12, rtol=0)
    # To the right, away from the camera, down: a right-handed frame, whatever the roll.
    torch.testing.assert_close(torch.linalg.cross(axes[1], axes[0]), down / down.norm())
    assert float(axes[1, 2]) > 0.5


def test_a_level_camera() -> None:
    torch.testing.assert_close(
        horizontal_axes(vector(GRAVITIES[0])), torch.eye(3, dtype=torch.float64)[[0, 2]]
    )


@pytest.mark.parametrize("gravity", GRAVITIES[:3])
@pytest.mark.parametrize("turn", [90, -90, 180])
def test_a_rolled_camera_sees_the_same_directions(gravity: tuple[float, ...], turn: float) -> None:
    """At 90°, a clip filmed upright: gravity along the image's x axis."""
    R = rolled(math.radians(turn))
    torch.testing.assert_close(horizontal_axes(R @ vector(gravity)), horizontal_axes(vector(gravity)) @ R.T)


def test_without_gravity_nothing_is_horizontal() -> None:
    with pytest.raises(InputError, match="gravity"):
        horizontal_axes(vector((0.0, 0.0, 0.0)))
