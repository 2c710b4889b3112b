"""Element stencils: which vertices each stretching, shearing and bending element couples.

The energies and the solver work on these index lists only, so a cloth on any mesh that can supply edges,
corner angles and straight angles goes through the same code (paper, Figure 4).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Stencils:
    """Index lists of the elements of one cloth with N vertices.

    Attributes:
        n_vertices: N.
        edges: (E, 2) int64, the two ends of every edge.
        corners: (C, 3) int64, (i, k, j): the warp and weft edges k->i and k->j enclose the angle at k.
        straights: (S, 3) int64, (i, k, j): two consecutive edges i->k and k->j of the same direction.
    """

    n_vertices: int
    edges: Tensor
    corners: Tensor
    straights: Tensor

    def __post_init__(self) -> None:
        for name, width in (("edges", 2), ("corners", 3), ("straights", 3)):
            index = getattr(self, name)
            if index.ndim != 2 or index.shape[1] != width:
                raise ValueError(f"{name}: expected shape (n, {width}), got {tuple(index.shape)}")
            if index.numel() and (int(index.min()) < 0 or int(index.max()) >= self.n_vertices):
                raise ValueError(
                    f"{name}: expected vertex indices in [0, {self.n_vertices}), "
                    f"got [{int(index.min())}, {int(index.max())}]"
                )


def grid_stencils(height: int, width: int) -> Stencils:
    """Stencils of an H×W grid; vertex (i, j) has index i * W + j.

    Every vertex contributes one corner per quad it belongs to and one straight angle per direction in which
    it has two neighbours.
    """
    if height < 2 or width < 2:
        raise ValueError(f"expected a grid of at least 2×2 vertices, got {height}×{width}")
    v = torch.arange(height * width).reshape(height, width)
    edges = torch.cat(
        (
            torch.stack((v[:-1].reshape(-1), v[1:].reshape(-1)), 1),
            torch.stack((v[:, :-1].reshape(-1), v[:, 1:].reshape(-1)), 1),
        )
    )
    a, b, c, d = v[:-1, :-1], v[:-1, 1:], v[1:, :-1], v[1:, 1:]
    corners = torch.cat(
        [torch.stack([t.reshape(-1) for t in ikj], 1) for ikj in ((c, a, b), (d, b, a), (a, c, d), (b, d, c))]
    )
    straights = torch.cat(
        (
            torch.stack((v[:-2].reshape(-1), v[1:-1].reshape(-1), v[2:].reshape(-1)), 1),
            torch.stack((v[:, :-2].reshape(-1), v[:, 1:-1].reshape(-1), v[:, 2:].reshape(-1)), 1),
        )
    )
    return Stencils(height * width, edges, corners, straights)
