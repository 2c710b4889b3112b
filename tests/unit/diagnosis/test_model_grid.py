"""The model's grid: what of a cloth it can have, and which of its vertices are held."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import torch

from toile.diagnosis.model_grid import ModelGrid, model_grid
from toile.physics.cloth import grid_cloth
from toile.physics.grid_laws import taut
from toile.scenes.scene import Scene

FINE = (33, 29)
SIZE = (0.6, 0.5)


def model(side: int, crowding: float, pinned: tuple[int, ...] = (0,)) -> ModelGrid:
    fine = grid_cloth(FINE, SIZE, 0.2, pinned, law=taut)
    return model_grid(cast(Scene, SimpleNamespace(grid=FINE)), fine, side, taut, crowding)


def test_crowded_lines_have_a_curled_border() -> None:
    """A border that curls within a fifteenth of the width."""
    u = np.linspace(0, 1, FINE[0])
    curl = np.repeat(np.exp(-u / 0.05)[:, None], FINE[1], 1).reshape(-1)
    missed = [
        float(np.abs(grid.prolong @ (grid.restrict @ curl) - curl).max())
        for grid in (model(14, 0.0), model(14, 0.5))
    ]
    assert missed[1] < 0.4 * missed[0]


@pytest.mark.parametrize("crowding", [0.0, 0.5])
def test_it_is_the_same_sheet(crowding: float) -> None:
    grid = model(12, crowding)
    assert grid.cloth_size == pytest.approx(SIZE)
    assert float(grid.cloth.masses.sum()) == pytest.approx(0.2 * SIZE[0] * SIZE[1])
    u, v = grid.cloth.lines.places()
    lengths = grid.cloth.rest_lengths
    first = lengths[: 11 * 12].reshape(11, 12)
    torch.testing.assert_close(first, (SIZE[0] * u.diff())[:, None].expand(11, 12))
    torch.testing.assert_close(lengths[11 * 12 :].reshape(12, 11), (SIZE[1] * v.diff()).expand(12, 11))
    smooth = np.cos(np.pi * np.linspace(0, 1, FINE[0]))[:, None] * np.ones(FINE[1])
    on_model = (grid.restrict @ smooth.reshape(-1)).reshape(12, 12)
    np.testing.assert_allclose(on_model, np.cos(np.pi * u.numpy())[:, None] * np.ones(12), atol=1e-3)


def test_the_nearest_vertices_are_held() -> None:
    H, W = FINE
    corners = (0, W - 1, (H - 1) * W, H * W - 1)
    assert model(14, 0.5, corners).cloth.pinned.tolist() == [0, 13, 13 * 14, 14 * 14 - 1]
    # A quarter down one side: lines there are closer to the border than on an even grid of as many.
    (even,), (crowded,) = (model(13, c, (8 * W,)).cloth.pinned.tolist() for c in (0.0, 0.6))
    u, _ = model(13, 0.6).cloth.lines.places()
    assert even == 3 * 13
    assert crowded == int((u - 0.25).abs().argmin()) * 13 == 4 * 13


def test_as_many_vertices_as_the_scene_has_are_the_scenes_or_crowded() -> None:
    same, crowded = model(40, 0.0), model(40, 0.5)
    assert same.grid == crowded.grid == FINE
    np.testing.assert_allclose(same.prolong, np.eye(len(same.prolong)), atol=1e-12)
    assert same.cloth.uneven is None
    assert crowded.cloth.uneven is not None
