"""One sheet on a lattice, and eight of them simulated at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
import warp as wp
from numpy.typing import NDArray

from toile.generation.fast.kernels import LANES, PARAMETERS, SLOW, Lanes, simulate
from toile.warp_runtime import start_warp, view

Array = NDArray[np.float64]
Indices = NDArray[np.int32]

# Rows of the table of what changes in time.
UNIFORM, NORMAL, PRESSURE, SCALE = slice(0, 3), slice(3, 6), 6, slice(7, 9)

_INDEX = {name: index for index, name in enumerate(PARAMETERS)}


@dataclass(frozen=True)
class Lattice:
    """Elements of an H × W grid, vertices row by row.

    Attributes:
        grid: (H, W).
        springs: (n, 3) ends and kind: 0 edges along axis 1, 1 along axis 0, 2 diagonals.
        cells: (n, 4).
        straights: (n, 3), first those along axis 1.
        n_along: number of straights along axis 1.
        areas: (N,) of every vertex in cells.
        places: (N, 2) fractions along axis 0 and 1.
    """

    grid: tuple[int, int]
    springs: Indices
    cells: Indices
    straights: Indices
    n_along: int
    areas: NDArray[np.float32]
    places: Array

    @property
    def n_vertices(self) -> int:
        """N."""
        return self.grid[0] * self.grid[1]

    @property
    def corners(self) -> tuple[int, int]:
        """The two corners of row 0, which are pinned."""
        return 0, self.grid[1] - 1


@lru_cache
def lattice(grid: tuple[int, int]) -> Lattice:
    """Elements of a grid."""
    H, W = grid
    i = np.arange(H * W).reshape(H, W)

    def rows(*columns: NDArray[np.int64]) -> Indices:
        return np.stack([c.ravel() for c in columns], 1).astype(np.int32)

    pairs = (
        (0, i[:, :-1], i[:, 1:]),
        (1, i[:-1], i[1:]),
        (2, i[:-1, :-1], i[1:, 1:]),
        (2, i[:-1, 1:], i[1:, :-1]),
    )
    springs = np.concatenate([rows(a, b, np.full_like(a, kind)) for kind, a, b in pairs])
    cells = rows(i[:-1, :-1], i[:-1, 1:], i[1:, :-1], i[1:, 1:])
    along, across = rows(i[:, :-2], i[:, 1:-1], i[:, 2:]), rows(i[:-2], i[1:-1], i[2:])
    areas = (0.25 * np.bincount(cells.ravel(), minlength=H * W)).astype(np.float32)
    u, v = np.linspace(0, 1, H), np.linspace(0, 1, W)
    places = np.stack(np.meshgrid(u, v, indexing="ij"), -1).reshape(-1, 2)
    return Lattice(grid, springs, cells, np.concatenate([along, across]), len(along), areas, places)


@dataclass
class Sheet:
    """One sheet with everything that acts on it, as arrays that effects change.

    Attributes:
        lattice: its elements.
        size: lengths along axis 1 and 0 [m].
        step: [s].
        parameters: by name (see kernels.PARAMETERS); those left out are 0.
        masses: (N,) [kg].
        springs: (n,) stiffness [N/m].
        cells: (n,) shear modulus of angles [N/m].
        straights: (n,) bending stiffness [N·m].
        rest_bends: (n,) curvature at rest [1/m].
        boundary: (T, 2, 3) positions of the pinned corners at the end of every step [m].
        series: (T / SLOW, 9): uniform wind, wind along normals, pressure [m/s²], scales of rest lengths.
    """

    lattice: Lattice
    size: tuple[float, float]
    step: float
    parameters: dict[str, float]
    masses: Array
    springs: Array
    cells: Array
    straights: Array
    rest_bends: Array
    boundary: Array
    series: Array = field(repr=False)

    @property
    def times(self) -> Array:
        """Times at the end of every step (T,) [s]."""
        return self.step * np.arange(1.0, len(self.boundary) + 1)

    @property
    def slow_times(self) -> Array:
        """Times of ``series`` [s]."""
        return self.step * SLOW * np.arange(0.0, len(self.series))

    @property
    def lengths(self) -> tuple[float, float]:
        """Rest lengths of edges along axis 1 and 0 [m]."""
        H, W = self.lattice.grid
        return self.size[0] / (W - 1), self.size[1] / (H - 1)


def no_series(n_steps: int) -> Array:
    """Table of what changes in time, of a sheet without any of it."""
    series = np.zeros((-(-n_steps // SLOW), 9))
    series[:, SCALE] = 1
    return series


def run(sheets: Sequence[Sheet], start: Array, per_frame: int) -> Array:
    """Simulate eight sheets on one lattice with the same number of steps, from rest.

    Symplectic Euler; a step must be shorter than 2 / ω of the stiffest mode.

    Args:
        sheets: LANES of them.
        start: (LANES, N, 3) positions at time 0 [m].
        per_frame: steps per frame.

    Returns:
        Positions (LANES, F, N, 3) [m], float32 precision; not finite where a sheet blew up.
    """
    if len(sheets) != LANES:
        raise ValueError(f"expected {LANES} sheets, got {len(sheets)}")
    start_warp()
    grid = sheets[0].lattice
    n = 3 * grid.n_vertices
    n_steps = len(sheets[0].boundary)
    frames = np.zeros((n_steps // per_frame + 1, n, LANES), np.float32)
    frames[0] = start.reshape(LANES, n).T
    x = frames[0].copy()
    lengths = np.array([s.lengths for s in sheets])
    spacing = np.ones(len(grid.straights), int)
    spacing[: grid.n_along] = 0
    square = lengths[:, spacing] ** 2
    empty = np.zeros((n, LANES), np.float32)

    def lanes(values: Sequence[Array] | Array) -> wp.array:
        stacked = np.moveaxis(np.asarray(values, np.float32), 0, -1)
        return view(np.ascontiguousarray(stacked), Lanes)

    # Straights bend by a second difference [m]: ½ B (c / L)², rest bend κ L².
    flags = np.array(
        [
            any(s.parameters.get("vortex", 0) != 0 for s in sheets),
            any(s.parameters.get("yield_rate", 0) != 0 for s in sheets),
            any(s.parameters.get("plane", 0) + s.parameters.get("ball", 0) > 0 for s in sheets),
            any(s.cells.any() for s in sheets),
        ],
        np.int32,
    )
    inputs = [
        view(x, Lanes),
        *(view(empty.copy(), Lanes) for _ in range(4)),
        lanes([_table(s) for s in sheets]),
        lanes([1 / s.masses for s in sheets]),
        view(grid.areas, wp.float32),
        view(grid.springs, wp.int32),
        lanes([s.springs for s in sheets]),
        view(grid.cells, wp.int32),
        lanes([s.cells for s in sheets]),
        view(grid.straights, wp.int32),
        lanes(np.array([s.straights for s in sheets]) / square),
        lanes(np.array([s.rest_bends for s in sheets]) * square),
        view(np.array(grid.corners, np.int32), wp.int32),
        lanes([s.boundary.reshape(n_steps, -1) for s in sheets]),
        lanes([s.series for s in sheets]),
        view(flags, wp.int32),
        per_frame,
        view(frames, Lanes),
    ]
    wp.launch(simulate, dim=1, inputs=inputs, device="cpu")
    return np.moveaxis(frames, -1, 0).reshape(LANES, len(frames), -1, 3).astype(np.float64)


def _table(sheet: Sheet) -> Array:
    """Numbers of one sheet in the kernel's order."""
    table = np.zeros(len(PARAMETERS))
    # A radius and a size of 1 where there is no ball and no vortex: nothing is divided by 0.
    for name, value in ({"radius": 1.0, "yield_bend": 1e9} | sheet.parameters).items():
        table[_INDEX[name]] = value
    table[_INDEX["step"]] = sheet.step
    table[_INDEX["length_u"]], table[_INDEX["length_v"]] = sheet.lengths
    return table
