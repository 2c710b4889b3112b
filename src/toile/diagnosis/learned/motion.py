"""A tracked motion as a smooth surface that moves: polynomials over the cloth, local polynomials in time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.signal import savgol_coeffs, savgol_filter

from toile.errors import InputError

Array = NDArray[np.float64]

SIDE = 16
"""Vertices per side after resampling."""
DEGREE = 7
"""Of the polynomials along each side of the cloth."""
TEST_DEGREE = 4
"""Of the test functions."""
_POINTS = 10  # of Gauss and Legendre per side: products of up to degree 19 are integrated exactly
_WINDOW = 0.18  # s; local polynomials of third order in time
_FEWEST = 24  # frames of a clip
_FEWEST_USED = 8  # of them that are looked at
_LEAST_FRAMES = 12


def window_of(fps: float) -> int:
    """Frames of a local polynomial, odd."""
    return max(5, 2 * round(_WINDOW * fps / 2) + 1)


def used_frames(n_frames: int, window: int) -> range:
    """Frames of a clip that features look at.

    Local polynomials are good for little at its ends, and smoothed frames tell the same as their neighbours.
    """
    n = max(window // 2 - 1, 1)
    return range(n, n_frames - n, max(1, window // 4))


def long_enough(n_frames: int, fps: float) -> bool:
    """Whether features of a clip say something: 24 frames at 50 a second, more where they follow faster."""
    return n_frames >= _FEWEST and len(used_frames(n_frames, window_of(fps))) >= _FEWEST_USED


@dataclass(frozen=True)
class Basis:
    """Polynomials at the vertices and at the points of quadrature; fractions of the cloth in [0, 1].

    Attributes:
        fit: (M, SIDE²) coefficients from vertices by least squares.
        vertices: (SIDE², M).
        values, du, dv, duu, dvv, duv: (Q, M) at the points; u along axis 1, v along axis 0, per fraction.
        test, test_du, test_dv, test_duu, test_dvv: (Q, J) test functions, orthonormal.
        weights: (Q,) that add up to 1.
        places: (Q, 2) fractions (u, v).
    """

    fit: Array
    vertices: Array
    values: Array
    du: Array
    dv: Array
    duu: Array
    dvv: Array
    duv: Array
    test: Array
    test_du: Array
    test_dv: Array
    test_duu: Array
    test_dvv: Array
    weights: Array
    places: Array


def _along(degree: int, places: Array, order: int) -> Array:
    """Orthonormal Legendre polynomials on [0, 1], or a derivative of them (n, degree + 1)."""
    columns = []
    for k in range(degree + 1):
        one = legendre.Legendre.basis(k).deriv(order)
        columns.append(np.sqrt(2 * k + 1) * one(2 * places - 1) * 2.0**order)
    return np.stack(columns, -1)


@lru_cache
def basis() -> Basis:
    """The one basis that is used."""
    roots, weights = legendre.leggauss(_POINTS)
    points, weights = (roots + 1) / 2, weights / 2
    side = np.linspace(0, 1, SIDE)

    def product(degree: int, v: Array, u: Array, dv: int, du: int) -> Array:
        rows, columns = _along(degree, v, dv), _along(degree, u, du)
        return np.einsum("ai,bj->abij", rows, columns).reshape(len(v) * len(u), -1)

    at = {order: product(DEGREE, points, points, *order) for order in _ORDERS}
    test = {order: product(TEST_DEGREE, points, points, *order) for order in _ORDERS}
    vertices = product(DEGREE, side, side, 0, 0)
    v, u = np.meshgrid(points, points, indexing="ij")
    return Basis(
        fit=np.asarray(np.linalg.pinv(vertices), np.float64),
        vertices=vertices,
        values=at[0, 0],
        du=at[0, 1],
        dv=at[1, 0],
        duu=at[0, 2],
        dvv=at[2, 0],
        duv=at[1, 1],
        test=test[0, 0],
        test_du=test[0, 1],
        test_dv=test[1, 0],
        test_duu=test[0, 2],
        test_dvv=test[2, 0],
        weights=np.outer(weights, weights).ravel(),
        places=np.stack([u.ravel(), v.ravel()], -1),
    )


_ORDERS = ((0, 0), (0, 1), (1, 0), (0, 2), (2, 0), (1, 1))


@dataclass(frozen=True)
class Motion:
    """A clip in its own frame: axes right, down, ahead; lengths in widths, accelerations in g.

    Time is counted in √(width / g), so that gravity is 1. The grid is turned so that the pinned vertices lie
    in its first row as far as they can.

    Attributes:
        raw: (F, SIDE, SIDE, 3) resampled positions.
        pins: (F, k, 3) positions of the pinned vertices.
        pin_places: (k, 2) fractions (u, v).
        interval: between frames.
        fps: [1/s]; width [m]; sides (u, v) in widths.
    """

    raw: Array
    pins: Array
    pin_places: Array
    interval: float
    fps: float
    width: float
    sides: tuple[float, float]

    @property
    def window(self) -> int:
        """Frames of a local polynomial, odd."""
        return window_of(self.fps)

    @cached_property
    def rough(self) -> Array:
        """Coefficients (F, M, 3) frame by frame."""
        F = len(self.raw)
        return np.matmul(basis().fit, self.raw.reshape(F, SIDE * SIDE, 3))

    def coefficients(self, order: int) -> Array:
        """Smoothed coefficients (F, M, 3), or their derivatives in time."""
        return self.smoothed(self.rough, order)

    def smoothed(self, series: Array, order: int = 0, degree: int = 3) -> Array:
        """Local polynomials in time through a series (F, ...), or their derivative of an order."""
        F = len(series)
        flat = _smoothing(F, self.window, degree, order) @ series.reshape(F, -1)
        return flat.reshape(series.shape) / self.interval**order

    @cached_property
    def misfit(self) -> float:
        """Root mean square of what polynomials over the cloth leave, per component."""
        left = self.raw.reshape(len(self.raw), -1, 3) - np.matmul(basis().vertices, self.rough)
        return float(np.sqrt((left[1:] ** 2).mean()))

    @cached_property
    def roughness(self) -> Array:
        """Root mean square per mode and axis (M, 3) of what the smoothing in time leaves."""
        left = self.rough - self.coefficients(0)
        result: Array = np.sqrt((left[2:-2] ** 2).mean(0))
        return result

    @cached_property
    def acceleration_noise(self) -> float:
        """Deviation of one coefficient's acceleration, from what smoothing leaves."""
        gain = np.sqrt((savgol_coeffs(self.window, 3, deriv=2, delta=self.interval) ** 2).sum())
        kept = np.sqrt(max(1 - savgol_coeffs(self.window, 3)[self.window // 2], 0.05))
        return float(np.median(self.roughness[:25]) / kept * gain)


def observed_motion(
    positions: Array,
    pinned: Sequence[int],
    fps: float,
    gravity: Array,
    cloth_size: tuple[float, float],
) -> Motion:
    """A motion in its own frame.

    Args:
        positions: (F, H, W, 3) [m].
        pinned: flattened indices of the pinned vertices, one or more.
        fps: frames per second.
        gravity: (3,) [m/s²].
        cloth_size: along axis 1 and 0 [m].

    Raises:
        InputError: too few frames, no pinned vertex, or numbers that are not finite.
    """
    positions = np.asarray(positions, np.float64)
    _check(positions, pinned)
    if not np.isfinite(positions).all():
        raise InputError("Positions are not finite", where="positions", expected="numbers", got="nan or inf")
    _, H, W, _ = positions.shape
    rows, columns = np.divmod(np.asarray(pinned), W)
    sides = (float(cloth_size[0]), float(cloth_size[1]))
    # Whichever side the cloth hangs from becomes row 0.
    v, u = rows / (H - 1), columns / (W - 1)
    if abs(u.mean() - 0.5) > abs(v.mean() - 0.5) + 1e-9:
        positions, (v, u), sides = positions.transpose(0, 2, 1, 3), (u, v), (sides[1], sides[0])
    if v.mean() > 0.5:
        positions, v = positions[:, ::-1], 1 - v
    g = float(np.linalg.norm(gravity))
    width = 0.5 * (sides[0] + sides[1])
    axes = _axes(positions, v, u, np.asarray(gravity, np.float64) / g)
    local = (positions - positions[0].mean((0, 1))) @ axes.T / width
    pins = _at(local, v, u)
    return Motion(
        raw=_resampled(local),
        pins=pins,
        pin_places=np.stack([u, v], -1),
        interval=float(1 / fps * np.sqrt(g / width)),
        fps=float(fps),
        width=width,
        sides=(sides[0] / width, sides[1] / width),
    )


def _check(positions: Array, pinned: Sequence[int]) -> None:
    if positions.ndim != 4 or positions.shape[-1] != 3 or min(positions.shape[1:3]) < 4:
        raise InputError(
            "Positions have another shape",
            where="positions",
            expected="(F, H, W, 3), H, W >= 4",
            got=str(positions.shape),
        )
    if len(positions) < _LEAST_FRAMES:
        raise InputError(
            "Too few frames", where="positions", expected=f"{_LEAST_FRAMES} or more", got=str(len(positions))
        )
    if not len(pinned):
        raise InputError("No vertex is pinned", where="pinned", expected="one or more", got="none")


def _axes(positions: Array, v: Array, u: Array, down: Array) -> Array:
    """Right, down and ahead (3, 3) as rows: right along the first row, ahead across the cloth."""
    along = (positions[0, :, -1] - positions[0, :, 0]).mean(0)
    along = along - (along @ down) * down
    if np.linalg.norm(along) < 1e-6:
        along = np.cross(down, [1.0, 0.3, 0.2])
    right = along / np.linalg.norm(along)
    return np.stack([right, down, np.cross(right, down)])


def _at(positions: Array, v: Array, u: Array) -> Array:
    H, W = positions.shape[1:3]
    rows, columns = np.round(v * (H - 1)).astype(int), np.round(u * (W - 1)).astype(int)
    return positions[:, rows, columns]


@lru_cache
def _smoothing(n_frames: int, window: int, degree: int, order: int) -> Array:
    """Local polynomials as a matrix (F, F), per frame."""
    matrix: Array = savgol_filter(np.eye(n_frames), window, degree, deriv=order, axis=0)
    return matrix


@lru_cache
def _spline(n: int) -> Array:
    """Values (SIDE, n) of a cubic spline through n vertices."""
    matrix: Array = CubicSpline(np.linspace(0, 1, n), np.eye(n))(np.linspace(0, 1, SIDE))
    return matrix


def _resampled(positions: Array) -> Array:
    H, W = positions.shape[1:3]
    if (H, W) == (SIDE, SIDE):
        return positions
    result: Array = np.einsum("ah,bw,fhwc->fabc", _spline(H), _spline(W), positions, optimize=True)
    return result
