"""New cloths where steps fail."""

from __future__ import annotations

import pytest
import torch

from toile.learning.surrogate.emphasis import Emphasis
from toile.learning.surrogate.materials import MaterialRanges

BOX = MaterialRanges((10.0, 1e4), (0.01, 10.0), (0.001, 10.0))
EVEN = Emphasis(levels=3, corners=0.0, evenly=0.0, memory=0.5)


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def test_places_and_stiffnesses_are_inverse() -> None:
    places = torch.tensor([[0.0, 0.5, 1.0], [0.25, 1.0, 0.0]])
    stiffness = BOX.at(places)
    torch.testing.assert_close(stiffness[0], torch.tensor([10.0, 0.01 * 1000**0.5, 10.0]))
    torch.testing.assert_close(BOX.places(stiffness), places)
    narrow = MaterialRanges((5.0, 5.0), (0.01, 10.0), (0.001, 10.0))
    assert BOX.places(stiffness).isfinite().all()
    assert narrow.places(narrow.at(places)).isfinite().all()


def test_what_fails_is_drawn() -> None:
    stiff = torch.tensor([[9e3, 9.0, 9.0]])
    failures = EVEN.noted(torch.zeros(27), BOX, stiff, torch.ones(1))
    assert failures.tolist() == [0.0] * 26 + [0.5]
    drawn = EVEN.sample(50, BOX, failures, 1.0, generator())
    assert (BOX.places(drawn) > 2 / 3 - 1e-5).all()
    assert len(drawn.unique(dim=0)) == 50


def test_failures_fade_with_every_cloth_that_does_well() -> None:
    soft = torch.tensor([[11.0, 0.011, 0.0011]]).repeat(3, 1)
    failures = EVEN.noted(torch.ones(27), BOX, soft, torch.zeros(3))
    assert failures[0] == pytest.approx(0.125)
    assert (failures[1:] == 1).all()


def test_corners_are_exact() -> None:
    corners = Emphasis(levels=2, corners=1.0, evenly=1.0, memory=0.5)
    drawn = corners.sample(200, BOX, corners.start(), 1.0, generator())
    assert len(drawn.unique(dim=0)) == 8
    torch.testing.assert_close(drawn.amax(0), torch.tensor([1e4, 10.0, 10.0]))
    torch.testing.assert_close(drawn.amin(0), torch.tensor([10.0, 0.01, 0.001]))


def test_a_share_leaves_out_the_stiff_end() -> None:
    half = EVEN.sample(300, BOX, EVEN.start(), 0.5, generator())
    assert BOX.places(half).max() <= 0.5 + 1e-5
    assert BOX.places(BOX.sample(300, generator(), 0.5)).max() <= 0.5 + 1e-5
    assert torch.equal(BOX.sample(9, generator()), BOX.sample(9, generator(), 1.0))
