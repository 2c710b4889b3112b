"""What of a moving triangle mesh comes near itself, and how far it may move before it meets itself.

Pairs of a vertex and a face and pairs of edges are found by bounding volume trees (Warp's) and listed; a list
is good until vertices have moved so far that others could meet.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from toile.geometry import self_proximity_kernels as kernels
from toile.warp_runtime import start_warp, view

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

# Boxes are of single precision: this much larger [m].
_SINGLE = 1e-5
# Share of its distance that a pair keeps when a motion is stopped.
_KEPT = 0.25
# A list that has to reach farther reaches this much farther.
_LARGER = 1.2
# Times that vertices are set back before all are.
_ATTEMPTS = 8
# Pairs that a list has place for at first, per vertex.
_PLACES = 16


@dataclass(frozen=True)
class Pairs:
    """M pairs of places on a mesh, the nearest of a vertex and a face or of two edges.

    Attributes:
        vertices: (M, 4); see self_proximity_kernels.
        weights: (M, 4) of these in the two places; each place's sum to 1.
        first: (M,) how many of the vertices are of the first place: 1 or 2.
        distances: (M,) [m].
    """

    vertices: Indices
    weights: Array
    first: Indices
    distances: Array

    def some(self, kept: NDArray[np.bool_]) -> Pairs:
        """Only those for which ``kept`` (M,) holds."""
        return Pairs(self.vertices[kept], self.weights[kept], self.first[kept], self.distances[kept])


class SelfProximity:
    """See the module.

    Args:
        n_vertices: N.
        faces: (T, 3).
        edges: (E, 2).
        held: vertices (n,) whose motion is given; pairs of these alone are left out.
        reach: distance of the pairs that are listed [m], or more where vertices go far.

    Attributes:
        passing: (N,) int32, not 0 at vertices whose pairs may meet.
    """

    def __init__(self, n_vertices: int, faces: Indices, edges: Indices, held: Indices, reach: float) -> None:
        start_warp()
        self.reach = reach
        self._n = n_vertices
        self._faces = np.ascontiguousarray(faces, np.int32)
        self._edges = np.ascontiguousarray(edges, np.int32)
        self._held = np.zeros(n_vertices, np.int32)
        self._held[held] = 1
        self.passing = np.zeros(n_vertices, np.int32)
        self._face_tree, self._edge_tree = _Tree(self._faces), _Tree(self._edges)
        self._pairs = np.zeros((_PLACES * n_vertices, 4), np.int32)
        self._distances = np.zeros(len(self._pairs))
        self._n_faces = self._n_pairs = 0
        self._known: Array | None = None
        self._listed = 0.0

    def near(self, x: Array, within: float) -> Pairs:
        """Pairs that are nearer than ``within`` [m], which is below the reach; x (N, 3) [m]."""
        x = np.ascontiguousarray(x, np.float64)
        self._cover(x, 0.0, within)
        m = self._n_pairs
        weights, distances = np.empty((m, 4)), np.empty(m)
        wp.launch(
            kernels.nearest_of_pairs,
            dim=m,
            inputs=[
                view(x, wp.vec3d),
                view(self._pairs, wp.int32),
                self._n_faces,
                view(weights, wp.vec4d),
                view(distances, wp.float64),
            ],
            device="cpu",
        )
        passing = (self.passing[self._pairs[:m]] != 0).any(1)
        kept = np.flatnonzero((distances < within) & ~passing)
        first = np.where(kept < self._n_faces, 1, 2)
        return Pairs(self._pairs[kept].astype(np.int64), weights[kept], first, distances[kept])

    def free_way(self, x: Array, moves: Array) -> Array:
        """Share (N,) of its way, up to 1, that each vertex may go from x (N, 3) [m] by moves (N, 3) [m].

        All go at the same time, the whole way in the end; no pair meets. Vertices that would are set back, no
        others. Those that are held go all the way, and what they would meet as well if nothing else is left.
        """
        x, moves = (np.ascontiguousarray(a, np.float64) for a in (x, moves))
        shares = np.ones(self._n)
        farthest = float(np.linalg.norm(moves - moves.mean(0), axis=1).max(initial=0.0))
        self._cover(x, farthest)
        for attempt in range(_ATTEMPTS):
            times = self._times(x, shares[:, None] * moves)
            if times.min() == 1.0:
                break
            # Setting back some may bring others together; in the end all are.
            shares *= times if attempt < _ATTEMPTS - 1 else times.min()
            shares[self._held != 0] = 1.0
        return shares

    def crossings(self, x: Array) -> int:
        """Number of edges times faces that go through each other, without a common vertex; x (N, 3) [m]."""
        return int(self._crossing(x)[0].sum())

    def crossing_vertices(self, x: Array) -> NDArray[np.bool_]:
        """Whether an edge or face of each vertex is one of these (N,); x (N, 3) [m]."""
        crossing: NDArray[np.bool_] = self._crossing(x)[1] != 0
        return crossing

    def _crossing(self, x: Array) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Number of faces that each edge goes through (E,), and marks at the vertices of both (N,)."""
        x = np.ascontiguousarray(x, np.float64)
        counts, marks = np.zeros(len(self._edges), np.int32), np.zeros(self._n, np.int32)
        wp.launch(
            kernels.crossing_faces,
            dim=len(self._edges),
            inputs=[
                self._face_tree.around(x, 0.0),
                view(x, wp.vec3d),
                view(self._edges, wp.int32),
                view(self._faces, wp.int32),
                view(counts, wp.int32),
                view(marks, wp.int32),
            ],
            device="cpu",
        )
        return counts, marks

    def _times(self, x: Array, moves: Array) -> Array:
        """Shares of the moves up to which the pairs of each vertex stay apart (N,)."""
        assert self._known is not None
        times = np.ones(self._n)
        moves = np.ascontiguousarray(moves)
        wp.launch(
            kernels.contact_times,
            dim=self._n_pairs,
            inputs=[
                view(x, wp.vec3d),
                view(moves, wp.vec3d),
                view(self._known, wp.vec3d),
                view(self._pairs, wp.int32),
                self._n_faces,
                view(self._distances, wp.float64),
                view(self.passing, wp.int32),
                _KEPT,
                view(times, wp.float64),
            ],
            device="cpu",
        )
        return times

    def _cover(self, x: Array, far: float, within: float = 0.0) -> None:
        """See that all pairs are listed that come nearer than ``within`` if vertices go ``far`` from x."""
        gone = 0.0
        if self._known is not None:
            moved = x - self._known
            gone = float(np.sqrt(np.square(moved - moved.mean(0)).sum(1).max(initial=0.0)))
        if self._known is None or 2 * (gone + far) + within > self._listed:
            self._list(x, max(self.reach, _LARGER * (2 * far + within)))

    def _list(self, x: Array, reach: float) -> None:
        """List the pairs within a reach [m] at x."""
        self._listed = reach
        faces, edges = (tree.around(x, reach) for tree in (self._face_tree, self._edge_tree))
        while True:
            count = np.zeros(1, np.int32)
            self._n_faces = self._collect(kernels.near_faces, faces, x, self._n, self._faces, count)
            self._n_pairs = self._collect(kernels.near_edges, edges, x, len(self._edges), self._edges, count)
            if self._n_pairs <= len(self._pairs):
                break
            self._pairs = np.zeros((2 * self._n_pairs, 4), np.int32)
            self._distances = np.zeros(len(self._pairs))
        self._known = x.copy()

    def _collect(
        self, kernel: Any, tree: Any, x: Array, n: int, elements: NDArray[np.int32], count: NDArray[np.int32]
    ) -> int:
        """Add pairs to the list, and return how many it has."""
        wp.launch(
            kernel,
            dim=n,
            inputs=[
                tree,
                view(x, wp.vec3d),
                view(elements, wp.int32),
                view(self._held, wp.int32),
                self._listed,
                view(count, wp.int32),
                view(self._pairs, wp.int32),
                view(self._distances, wp.float64),
            ],
            device="cpu",
        )
        return int(count[0])


class _Tree:
    """Bounding volume tree of elements (E, k) of a mesh."""

    def __init__(self, elements: NDArray[np.int32]) -> None:
        self._elements = elements
        self._lowers = np.zeros((len(elements), 3), np.float32)
        self._uppers = np.zeros((len(elements), 3), np.float32)
        self._bvh: Any = None

    def around(self, x: Array, margin: float) -> Any:
        """Warp's number of the tree of boxes with a margin [m], for vertices x (N, 3) [m]."""
        lowers, uppers = view(self._lowers, wp.vec3f), view(self._uppers, wp.vec3f)
        wp.launch(
            kernels.boxes,
            dim=len(self._elements),
            inputs=[view(x, wp.vec3d), view(self._elements, wp.int32), margin + _SINGLE, lowers, uppers],
            device="cpu",
        )
        if self._bvh is None:
            self._views = lowers, uppers
            self._bvh = wp.Bvh(lowers, uppers)
        else:
            self._bvh.refit()
        return self._bvh.id
