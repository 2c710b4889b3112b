"""Corners and sides of outlines, and the grid between them."""

from __future__ import annotations

import numpy as np
import pytest

from toile.errors import InputError
from toile.geometry.quadrilateral import (
    exact_side,
    four_corners,
    grid_between,
    named_corners,
    sides,
    smooth_side,
)


def rectangle(n: int = 20, turn: float = 0.0, size=(3.0, 2.0)) -> np.ndarray:
    """4n points, the corners at 0, n, 2n and 3n; clockwise in an image."""
    s = np.linspace(0, 1, n, endpoint=False)
    zero, one = np.zeros(n), np.ones(n)
    square = [(s, zero), (one, s), (1 - s, one), (zero, 1 - s)]
    points = np.concatenate([np.column_stack(side) for side in square]) * size
    c, d = np.cos(turn), np.sin(turn)
    return points @ np.array([[c, d], [-d, c]])


@pytest.mark.parametrize("turn", [0.0, 0.4, 2.0])
@pytest.mark.parametrize("shift", [0, 7])
def test_corners_of_a_rectangle(turn, shift) -> None:
    outline = np.roll(rectangle(turn=turn), shift, axis=0)
    assert sorted((k - shift) % 80 for k in four_corners(outline, "here")) == [0, 20, 40, 60]


def test_corners_survive_a_ragged_outline() -> None:
    outline = rectangle(60) + np.random.default_rng(0).normal(0, 0.01, (240, 2))
    found = np.array(four_corners(outline, "here"))
    assert np.abs((found - [0, 60, 120, 180] + 120) % 240 - 120).max() <= 2


@pytest.mark.parametrize("corners", [3, 60])
def test_triangle_and_circle_have_not_four_corners(corners) -> None:
    angle = np.linspace(0, 2 * np.pi, corners, endpoint=False)
    polygon = np.column_stack((np.cos(angle), np.sin(angle)))
    s = np.linspace(0, 1, 30, endpoint=False)[:, None]
    outline = np.concatenate([a + s * (b - a) for a, b in zip(polygon, np.roll(polygon, -1, 0), strict=True)])
    with pytest.raises(InputError, match="four corners"):
        four_corners(outline, "here")


@pytest.mark.parametrize("turn", [-0.5, 0.0, 0.5])
@pytest.mark.parametrize("shift", range(4))
@pytest.mark.parametrize("mirrored", [False, True])
def test_names_do_not_depend_on_order_or_start(turn, shift, mirrored) -> None:
    named = rectangle(1, turn)
    order = np.roll(np.arange(4)[:: -1 if mirrored else 1], shift)
    found = named[order][list(named_corners(named[order]))]
    np.testing.assert_array_equal(found, named)


@pytest.mark.parametrize("backwards", [False, True])
def test_sides_in_either_direction(backwards) -> None:
    outline = np.roll(rectangle(10), 3, axis=0)
    corners = [3, 13, 23, 33]
    if backwards:
        outline, corners = outline[::-1], [39 - k for k in corners]
    upper, right, lower, left = sides(outline, corners)
    np.testing.assert_allclose(upper[[0, -1]], [[0, 0], [3, 0]], atol=1e-12)
    np.testing.assert_allclose(right[[0, -1]], [[3, 0], [3, 2]], atol=1e-12)
    np.testing.assert_allclose(lower[[0, -1]], [[3, 2], [0, 2]], atol=1e-12)
    np.testing.assert_allclose(left[[0, -1]], [[0, 2], [0, 0]], atol=1e-12)
    assert {len(side) for side in (upper, right, lower, left)} == {11}


@pytest.mark.parametrize("fit", [exact_side, smooth_side])
def test_grid_of_a_rectangle_is_regular(fit) -> None:
    quad = sides(rectangle(30, turn=0.3), (0, 30, 60, 90))
    grid = grid_between(quad, (7, 5), fit)
    np.testing.assert_allclose(np.linalg.norm(np.diff(grid, axis=0), axis=-1), 0.5, rtol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(np.diff(grid, axis=1), axis=-1), 0.5, rtol=1e-3)
    np.testing.assert_allclose(grid[0, 0], quad[0][0], atol=1e-9)
    np.testing.assert_allclose(grid[-1, 0], quad[1][0], atol=1e-9)
    np.testing.assert_allclose(grid[-1, -1], quad[2][0], atol=1e-9)
    np.testing.assert_allclose(grid[0, -1], quad[3][0], atol=1e-9)


def test_smooth_side_follows_a_bow_but_no_dent() -> None:
    x = np.linspace(0, 1, 200)
    bow = 0.2 * x * (1 - x)
    dented = bow + np.where(np.abs(x - 0.3) < 0.02, 0.05, 0)
    found = smooth_side(np.column_stack((x, dented)), 50, degree=4)
    expected = np.interp(found[:, 0], x, bow)
    assert np.abs(found[:, 1] - expected).max() < 0.005
    lengths = np.linalg.norm(np.diff(found, axis=0), axis=1)
    np.testing.assert_allclose(lengths, lengths.mean(), rtol=1e-2)


def test_side_that_turns_back_is_kept() -> None:
    angle = np.linspace(0, 1.9 * np.pi, 100)
    side = np.column_stack((np.cos(angle), np.sin(angle)))
    np.testing.assert_array_equal(smooth_side(side, 30), exact_side(side, 30))
