"""Who is whose neighbour on a triangle mesh; a grid is one of its makers."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from toile.geometry.mesh import grid_faces


@dataclass(frozen=True)
class Topology:
    """Connectivity of a manifold triangle mesh with N vertices, all faces turned to the same side.

    Attributes:
        n_vertices: N.
        faces: (T, 3) int64.
        grid: (H, W) where vertex (i, j) of a grid has index i · W + j, else None.
    """

    n_vertices: int
    faces: Tensor
    grid: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        if self.faces.ndim != 2 or self.faces.shape[1] != 3:
            raise ValueError(f"faces: expected shape (n, 3), got {tuple(self.faces.shape)}")
        if not len(self.faces):
            raise ValueError("faces: expected at least one, got none")
        if int(self.faces.min()) < 0 or int(self.faces.max()) >= self.n_vertices:
            raise ValueError(
                f"faces: expected vertex indices in [0, {self.n_vertices}), "
                f"got [{int(self.faces.min())}, {int(self.faces.max())}]"
            )
        directed = self._directed
        _, first, counts = np.unique(directed, axis=0, return_index=True, return_counts=True)
        if counts.max() > 1:
            edge = directed[first[int(counts.argmax())]].tolist()
            raise ValueError(
                "faces: expected a manifold whose faces all turn to the same side, "
                f"got edge {edge[0]}->{edge[1]} in {int(counts.max())} faces of the same direction"
            )

    @staticmethod
    def of_grid(height: int, width: int) -> Topology:
        """H×W vertices, every cell cut into two triangles."""
        return Topology(height * width, grid_faces(height, width), (height, width))

    @cached_property
    def edges(self) -> Tensor:
        """Every edge once, (E, 2) int64, the smaller index first, sorted."""
        return torch.from_numpy(np.unique(np.sort(self._directed, 1), axis=0))

    @cached_property
    def hinges(self) -> Tensor:
        """Inner edges with the vertices across, (I, 4) int64: faces (0, 1, 2) and (1, 0, 3) share edge 0-1.

        The edge runs as in the first of the two faces; sorted.
        """
        directed = self._directed
        across = self.faces.numpy()[:, [2, 0, 1]].T.reshape(-1)
        n = self.n_vertices
        key = directed[:, 0] * n + directed[:, 1]
        order = np.argsort(key)
        back = directed[:, 1] * n + directed[:, 0]
        place = np.searchsorted(key[order], back).clip(max=len(key) - 1)
        twin = order[place]
        inner = (key[twin] == back) & (directed[:, 0] < directed[:, 1])
        hinges = np.column_stack((directed[inner], across[inner], across[twin[inner]]))
        return torch.from_numpy(hinges[np.lexsort(hinges.T[[1, 0]])])

    @cached_property
    def boundary(self) -> tuple[Tensor, ...]:
        """Closed loops of vertices along the rims, longest first; none for a closed surface."""
        import igl  # it takes a while, and only garments ask

        loops = igl.boundary_loop_all(self.faces.numpy())
        return tuple(torch.tensor(loop, dtype=torch.int64) for loop in sorted(loops, key=len, reverse=True))

    @cached_property
    def neighbours(self) -> tuple[Tensor, ...]:
        """Vertices that share an edge with each vertex, sorted."""
        both = np.concatenate((self.edges.numpy(), self.edges.numpy()[:, ::-1]))
        both = both[np.lexsort(both.T[::-1])]
        starts = np.searchsorted(both[:, 0], np.arange(1, self.n_vertices))
        return tuple(torch.from_numpy(part) for part in np.split(both[:, 1], starts))

    @property
    def _directed(self) -> np.ndarray[tuple[int, int], np.dtype[np.int64]]:
        """The three edges of every face in its direction, (3T, 2): first those from vertex 0 to 1."""
        faces = self.faces.numpy()
        return np.concatenate([faces[:, [a, (a + 1) % 3]] for a in range(3)])
