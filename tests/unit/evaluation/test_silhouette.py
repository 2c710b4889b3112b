from __future__ import annotations

import pytest
import torch

from toile.errors import InputError
from toile.evaluation.silhouette import intersection_over_union


@pytest.mark.parametrize(("shift", "expected"), [(0, 1.0), (1, 9 / 11), (5, 5 / 15), (10, 0.0)])
def test_shifted_squares(shift: int, expected: float) -> None:
    a, b = torch.zeros(1, 20, 24), torch.zeros(1, 20, 24)
    a[:, 4:14, 2:12] = 1.0
    b[:, 4:14, 2 + shift : 12 + shift] = 0.8
    assert intersection_over_union(a, b).tolist() == pytest.approx([expected])


def test_two_empty_images_agree() -> None:
    assert intersection_over_union(torch.zeros(2, 4, 4), torch.full((2, 4, 4), 0.5)).tolist() == [1.0, 1.0]


def test_other_size_raises() -> None:
    with pytest.raises(InputError, match="differ in size"):
        intersection_over_union(torch.zeros(1, 4, 4), torch.zeros(1, 4, 5))
