"""Shifted outlines and smoothed areas."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from toile.diagnosis.garment.masks import SmoothedAreas, shifted
from toile.errors import InputError


def disc(radius: float, side: int = 64) -> torch.Tensor:
    """Antialiased (1, side, side)."""
    rows, columns = torch.meshgrid(torch.arange(side) + 0.5, torch.arange(side) + 0.5, indexing="ij")
    distance = ((rows - side / 2) ** 2 + (columns - side / 2) ** 2).sqrt()
    return (0.5 + radius - distance).clamp(0, 1)[None]


@pytest.mark.parametrize("bias", [0.5, -0.5, 1.5])
def test_a_shifted_disc_has_the_area_of_a_larger_one(bias: float) -> None:
    grown = float(shifted(disc(15.0), bias).sum())
    assert grown == pytest.approx(np.pi * (15.0 + bias) ** 2, rel=0.02)
    assert torch.equal(shifted(disc(15.0), 0.0), disc(15.0))


def test_smoothed_areas_answer_linearly_where_pixels_do_not() -> None:
    def masks(radius: float) -> np.ndarray:
        return (disc(radius) > 0.5).double().numpy()[None, None]

    def off_line(form) -> float:
        """What a step up and one down have not in common, over their size."""
        up, down = form(masks(16.0)) - form(masks(15.0)), form(masks(15.0)) - form(masks(14.0))
        return float(np.linalg.norm(up - down) / np.linalg.norm(up + down))

    assert off_line(SmoothedAreas(16)) < 0.35
    assert off_line(lambda m: m) > 0.9
    assert SmoothedAreas(16)(masks(15.0)).shape == (1, 1, 1, 16, 16)


def test_masks_below_the_grid_are_refused() -> None:
    with pytest.raises(InputError, match="16 px"):
        SmoothedAreas(32)(np.zeros((1, 2, 1, 16, 16)))
