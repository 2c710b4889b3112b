"""Cleaning of masks, and warnings about sequences of them."""

from __future__ import annotations

import numpy as np
import pytest

from toile.errors import InputError
from toile.preparation.segmentation.checks import check_sequence, measure
from toile.preparation.segmentation.cleaning import Cleaning


def sheet() -> np.ndarray:
    """20 × 20 px with a hole of 2 × 2 and one of 6 × 6, beside 5 × 5 px."""
    mask = np.zeros((40, 40), dtype=bool)
    mask[5:25, 5:25] = True
    mask[7:9, 7:9] = False
    mask[14:20, 14:20] = False
    mask[30:35, 30:35] = True
    return mask


@pytest.mark.parametrize(
    ("minimum", "hole", "area"),
    [
        (0, 0, 400 - 4 - 36 + 25),
        (1, 0, 400 - 4 - 36),
        (0.05, 0.02, 400 - 36 + 25),
        (0.1, 1, 400),
        (0.06, 1, 425),
    ],
)
def test_components_and_holes(minimum, hole, area) -> None:
    mask = sheet()
    assert Cleaning(minimum_component=minimum, largest_hole=hole)(mask).sum() == area
    assert np.array_equal(mask, sheet())


def test_an_empty_mask_stays_empty() -> None:
    assert not Cleaning()(np.zeros((5, 6), dtype=bool)).any()


@pytest.mark.parametrize("bad", [{"minimum_component": 1.1}, {"largest_hole": -0.1}])
def test_fractions(bad) -> None:
    with pytest.raises(InputError, match="fraction"):
        Cleaning(**bad)


def square(side: int, at: int = 5) -> np.ndarray:
    mask = np.zeros((40, 40), dtype=bool)
    mask[at : at + side, at : at + side] = True
    return mask


def test_a_jump_in_area_is_named_in_both_directions() -> None:
    measures = [measure(square(side)) for side in (10, 10, 12, 12, 10)]
    (finding,) = check_sequence(measures, 1.2, "here")
    assert "frames 2, 4" in finding.where
    assert "from 100 to 144 px at frame 2" in finding.got
    assert check_sequence(measures, 1.5, "here") == []


@pytest.mark.parametrize(
    ("side", "at", "touches"), [(10, 0, True), (10, 30, True), (10, 1, False), (10, 29, False)]
)
def test_a_mask_at_the_border_is_named(side, at, touches) -> None:
    findings = check_sequence([measure(square(10)), measure(square(side, at))], 1.2, "here")
    assert [("border" in f.what, f.where) for f in findings] == [(True, "here: frame 1")] * touches
