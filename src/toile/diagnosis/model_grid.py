"""The grid on which the diagnosis simulates, and what maps it to the scene's own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from toile.physics.cloth import Cloth, grid_cloth
from toile.physics.grid_laws import GridLaw
from toile.physics.grid_lines import Crowding, GridLines
from toile.physics.units import PAPER_TIME_STEP, NetworkUnits
from toile.scenes.scene import Scene

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ModelGrid:
    """A coarser cloth that stands for the scene's.

    Attributes:
        cloth: on the model's grid, uniform density.
        units: network units of its grid at the paper's time step.
        prolong: (N_scene, N_model) bicubic interpolation of vertex values.
        restrict: (N_model, N_scene) bicubic interpolation the other way.
        cloth_size: rest length of the sides [m].
    """

    cloth: Cloth
    units: NetworkUnits
    prolong: Array
    restrict: Array
    cloth_size: tuple[float, float]

    @property
    def grid(self) -> tuple[int, int]:
        """(H, W) of the model."""
        assert self.cloth.grid is not None
        return self.cloth.grid


def spline_matrix(places: Array, at: Array) -> Array:
    """Values of the cubic spline through values at places (n,) on [0, 1], (len(at), n)."""
    return np.asarray(CubicSpline(places, np.eye(len(places)), axis=0)(at))


def model_grids(scene: Scene, fine: Cloth, sides: Sequence[int]) -> list[ModelGrid]:
    """Models of ever more vertices; sizes beyond the scene's own grid count as that, and only once."""
    whole = max(scene.grid)
    return [model_grid(scene, fine, side) for side in dict.fromkeys(min(side, whole) for side in sides)]


def model_grid(
    scene: Scene, fine: Cloth, side: int | None, law: GridLaw | None = None, crowding: Crowding = 0.0
) -> ModelGrid:
    """A model of the scene's cloth with ``side`` vertices along each side; None for the scene's own grid.

    Rest lengths are arc lengths of the fine cloth at rest: a template that is not evenly spaced stays so.

    Args:
        scene: its grid and pinned vertices are used.
        fine: the scene's cloth; areal density, rest lengths, law.
        side: vertices.
        law: None for the scene's cloth's.
        crowding: of the model's lines towards the borders, see GridLines.
    """
    H, W = scene.grid
    h, w = (H, W) if side is None else (min(side, H), min(side, W))
    lines = GridLines.crowded(h, w, crowding)
    u, v = (places.numpy() for places in lines.places())
    fine_u, fine_v = np.linspace(0, 1, H), np.linspace(0, 1, W)
    prolong = np.kron(spline_matrix(u, fine_u), spline_matrix(v, fine_v))
    restrict = np.kron(spline_matrix(fine_u, u), spline_matrix(fine_v, v))
    rest = fine.rest_lengths.numpy()
    first: Array
    second: Array
    first, second = rest[: (H - 1) * W].reshape(H - 1, W), rest[(H - 1) * W :].reshape(H, W - 1)
    lengths = np.concatenate((_resample(first, u, v).reshape(-1), _resample(second.T, v, u).T.reshape(-1)))
    size = float(first.sum(0).mean()), float(second.sum(1).mean())
    area = size[0] * size[1]
    density = float(fine.masses.sum()) / area
    pinned = tuple(_nearest(int(k), (H, W), (u, v)) for k in fine.pinned)
    cloth = grid_cloth((h, w), size, density, pinned, torch.from_numpy(lengths), law or fine.law, lines)
    cell = area / ((h - 1) * (w - 1))
    units = NetworkUnits(density * cell, cell**0.5, PAPER_TIME_STEP)
    to_scene, to_model = np.asarray(prolong, np.float64), np.asarray(restrict, np.float64)
    return ModelGrid(cloth, units, to_scene, to_model, size)


def _resample(steps: Array, along: Array, across: Array) -> Array:
    """Edge lengths (len(along) - 1, len(across)) from those of a finer grid (n - 1, m)."""
    n, m = steps.shape[0] + 1, steps.shape[1]
    arc = np.concatenate((np.zeros((1, m)), np.cumsum(steps, 0)))
    at = np.stack([np.interp(along, np.linspace(0, 1, n), arc[:, j]) for j in range(m)], 1)
    lines = np.stack([np.interp(across, np.linspace(0, 1, m), row) for row in at])
    return np.diff(lines, axis=0)


def _nearest(vertex: int, fine: tuple[int, int], coarse: tuple[Array, Array]) -> int:
    """The vertex where the coarse lines come closest to a vertex of the fine, even grid."""
    at = [k / (n - 1) for k, n in zip(divmod(vertex, fine[1]), fine, strict=True)]
    a, b = (int(np.argmin(np.abs(places - k))) for places, k in zip(coarse, at, strict=True))
    return a * len(coarse[1]) + b
