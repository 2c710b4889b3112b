"""The mass of a border that has a hem, or less of one than thought."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from toile.diagnosis.hem import Hem, border_strip
from toile.effects.base import Surroundings
from toile.physics.cloth import grid_cloth

SIZE = (0.3, 0.36)
GRAVITY = torch.tensor([0.0, 9.81, 0.0], dtype=torch.float64)
CLOTH = grid_cloth((8, 8), SIZE, 0.2, (0, 7))
AROUND = Surroundings(CLOTH, SIZE, GRAVITY, 25.0, 3)


def masses(width: float) -> torch.Tensor:
    return Hem({"width": width}).masses(CLOTH.masses, AROUND)


def test_a_hem_weighs_what_its_strip_does() -> None:
    """3 mm of the border lie double: 1.32 m of it, of 0.2 kg/m²."""
    more = masses(0.003) - CLOTH.masses
    assert float(more.sum()) == pytest.approx(0.003 * 1.32 * 0.2)
    inside = more.reshape(8, 8)[1:-1, 1:-1]
    assert torch.equal(inside, torch.zeros_like(inside))
    missing = masses(-0.003) - CLOTH.masses
    torch.testing.assert_close(missing, -more)


@pytest.mark.parametrize("width", [-0.05, -0.02])
def test_no_vertex_loses_all_of_its_mass(width: float) -> None:
    """Corners of a crowded grid had less than none, where a fit ended in an error."""
    assert float((CLOTH.masses + width * torch.from_numpy(border_strip(AROUND))).min()) < 0
    assert float(masses(width).min()) > 0


def test_masses_follow_the_width_smoothly() -> None:
    """Where less and less is lost, no kink lies on a fit's way."""
    widths = np.linspace(-0.02, 0.001, 2001)
    corner = np.array([float(masses(w)[0]) for w in widths]) / float(CLOTH.masses[0])
    slopes = np.gradient(corner, widths)
    assert (slopes > 0).all()
    assert np.abs(np.diff(slopes)).max() < 0.01 * slopes.max()
    assert np.ptp(slopes[widths > -0.005]) < 1e-6 * slopes.max()
