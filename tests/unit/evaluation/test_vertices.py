from __future__ import annotations

import pytest
import torch

from toile.errors import InputError
from toile.evaluation.vertices import vertex_distances, vertex_error


def test_identical_vertices_have_no_error() -> None:
    x = torch.rand(2, 3, 4, 3, generator=torch.Generator().manual_seed(0))
    assert vertex_error(x, x).tolist() == [0.0, 0.0]


def test_shift_is_found_per_frame() -> None:
    x = torch.zeros(2, 3, 4, 3, dtype=torch.float64)
    y = x.clone()
    y[1] += torch.tensor([0.03, 0.04, 0.0], dtype=torch.float64)
    assert vertex_error(y, x).tolist() == pytest.approx([0.0, 0.05])
    assert vertex_distances(y, x).shape == (2, 3, 4)


def test_other_shape_raises() -> None:
    with pytest.raises(InputError, match=r"\(2, 3, 4, 3\)"):
        vertex_error(torch.zeros(2, 12, 3), torch.zeros(2, 3, 4, 3))
