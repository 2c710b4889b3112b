"""Symbolic analysis of the multifrontal Cholesky factorisation: all that depends on the pattern alone.

A supernode is a set of vertices that nested dissection eliminates together; its columns of L are one dense
panel. What their elimination changes among later columns is a dense update matrix, added into the panel and
the update matrix of the supernode's parent, the one of the first row below (Duff and Reid, The multifrontal
solution of indefinite sparse symmetric linear equations, 1983; Liu, The multifrontal method for sparse matrix
solution: theory and practice, 1992).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, cast

import numpy as np
import warp as wp
from numpy.typing import NDArray
from scipy.sparse import csr_array

from toile.physics.implicit.linear_solvers.dissection import nested_dissection
from toile.physics.implicit.linear_solvers.fortran import address
from toile.physics.implicit.linear_solvers.pattern import BlockPattern
from toile.physics.implicit.linear_solvers.sparse_kernels import Supernodes
from toile.warp_runtime import start_warp, view

Indices = NDArray[np.int64]

# Sets of vertices up to this size are one dense supernode. Measured on 1,000 to 10,000 vertices: from 8 to 32
# a factorisation takes the same time within a tenth; the larger they are, the shorter the analysis.
_LEAF = 24


class SymbolicAnalysis:
    """See the module.

    Args:
        pattern: of the matrix.
        pinned: (n_pinned,) vertices that leave it.

    Attributes:
        order: free vertices in the order of elimination.
        n_supernodes: number of supernodes.
        n_values: entries of all panels.
        n_work: entries of the update matrices that wait at the same time, at most.
        n_below: unknowns below the diagonal block of a supernode, at most.
        flops: multiplications and additions of a factorisation.
        supernodes: for the kernels.
    """

    def __init__(self, pattern: BlockPattern, pinned: Indices) -> None:
        is_free = np.ones(pattern.n_vertices, np.bool_)
        is_free[pinned] = False
        free, number = np.flatnonzero(is_free), np.cumsum(is_free) - 1
        kept = np.flatnonzero(is_free[pattern.rows] & is_free[pattern.columns])
        p, q = number[pattern.rows[kept]], number[pattern.columns[kept]]
        graph = _graph(len(free), p, q)
        tree = _Tree.of(graph, nested_dissection(graph, _LEAF))
        eliminated = _joined(tree.columns)
        self.order = free[eliminated]
        self.n_supernodes = n = len(tree.columns)
        position = np.empty(len(free), np.int64)
        position[eliminated] = np.arange(len(free))

        widths = np.array([len(c) for c in tree.columns], np.int64)
        k, u = 3 * widths, 3 * np.array([len(b) for b in tree.below], np.int64)
        first = np.cumsum(widths) - widths
        rows = [np.r_[f : f + w, b] for f, w, b in zip(first, widths, tree.below, strict=True)]
        places = [
            np.r_[np.zeros(w, np.int64), np.searchsorted(rows[parent], b) if len(b) else b]
            for w, b, parent in zip(widths, tree.below, tree.parents, strict=True)
        ]
        row_starts, panel_starts = _starts((k + u) // 3), _starts(k * (k + u))
        self.n_values, self.n_below = int(panel_starts[-1]), int(u.max(initial=0))
        self.flops = float((k**3 / 3 + k**2 * u + k * u**2).sum())

        parents = np.array(tree.parents, np.int64)
        children = np.argsort(parents, kind="stable")[int((parents < 0).sum()) :]
        child_ends = np.searchsorted(parents[children], np.arange(n), side="right")
        # Update matrices are a stack. Those of the children lie on top of it, in order, when a new one is
        # made; it moves to their place when they have been used.
        work_starts, update_starts = np.zeros(n, np.int64), np.zeros(n, np.int64)
        top = used = self.n_work = 0
        for s in range(n):
            work_starts[s] = top
            self.n_work = max(self.n_work, int(top + u[s] ** 2))
            update_starts[s] = update_starts[children[used]] if used < child_ends[s] else top
            used, top = int(child_ends[s]), int(update_starts[s] + u[s] ** 2)

        # The blocks of the matrix, sorted by the supernode that owns their column.
        owner = np.searchsorted(first, np.minimum(position[p], position[q]), side="right") - 1
        sorting = np.argsort(owner, kind="stable")
        p, q, owner = position[p][sorting], position[q][sorting], owner[sorting]
        row, column = np.maximum(p, q), np.minimum(p, q)
        keys = _joined([s * len(free) + r for s, r in enumerate(rows)])
        row_in_panel = np.searchsorted(keys, owner * len(free) + row) - row_starts[owner]

        arrays = {
            "widths": widths,
            "row_starts": row_starts,
            "rows": _joined(rows),
            "vertices": self.order[_joined(rows)],
            "places": _joined(places),
            "panel_starts": panel_starts,
            "work_starts": work_starts,
            "update_starts": update_starts,
            "child_ends": child_ends,
            "children": children,
            "block_starts": np.searchsorted(owner, np.arange(n + 1)),
            "sources": kept[sorting],
            "targets": 3 * ((column - first[owner]) * (k + u)[owner] + row_in_panel),
            "transposed": p < q,
        }
        start_warp()
        self.supernodes = supernodes = cast(Any, Supernodes())
        supernodes.n_supernodes, supernodes.n = n, 3 * len(free)
        for name, values in arrays.items():
            setattr(supernodes, name, view(np.ascontiguousarray(values, np.int64), wp.int64))
        for name in ("potrf", "trsm", "syrk", "gemm", "trsv", "gemv"):
            setattr(supernodes, name, wp.uint64(address("d" + name)))


def analyse(pattern: BlockPattern, pinned: Indices) -> SymbolicAnalysis:
    """The analysis of a pattern; those of the last patterns are kept."""
    return _analysis(pattern.n_vertices, *(a.tobytes() for a in (pattern.rows, pattern.columns, pinned)))


def forget_analyses() -> None:
    """Let go of the analyses that are kept."""
    _analysis.cache_clear()


@lru_cache(maxsize=8)
def _analysis(n_vertices: int, *arrays: bytes) -> SymbolicAnalysis:
    rows, columns, pinned = (np.frombuffer(a, np.int64) for a in arrays)
    return SymbolicAnalysis(BlockPattern(n_vertices, rows, columns), pinned)


def _joined(arrays: Sequence[Indices]) -> Indices:
    return np.concatenate((np.zeros(0, np.int64), *arrays))


def _starts(sizes: Indices) -> Indices:
    return np.concatenate((np.zeros(1, np.int64), np.cumsum(sizes)))


def _graph(n: int, p: Indices, q: Indices) -> csr_array:
    """Symmetric pattern (n, n) without diagonal."""
    p, q = p[p != q], q[p != q]
    ends = np.concatenate((p, q)), np.concatenate((q, p))
    return csr_array((np.ones(len(ends[0]), np.int8), ends), shape=(n, n))


class _Tree:
    """Supernodes, those below each right before it.

    Attributes:
        columns: vertices of each.
        below: places in the order of elimination of the rows below.
        parents: the supernode of the first of them; -1 where there is none.
    """

    def __init__(self, graph: csr_array, columns: Sequence[Indices]) -> None:
        self.columns = columns
        self.below: list[Indices] = []
        self.parents: list[int] = []
        position = np.empty(graph.shape[0], np.int64)
        position[_joined(columns)] = np.arange(graph.shape[0])
        ends = np.cumsum([len(c) for c in columns], dtype=np.int64)
        # What the elimination of earlier supernodes has coupled to each.
        coupled: list[list[Indices]] = [[] for _ in columns]
        for s, own in enumerate(columns):
            rows = np.unique(_joined([position[graph[own].indices], *coupled[s]]))
            rows = rows[rows >= ends[s]]
            parent = int(np.searchsorted(ends, rows[0], side="right")) if len(rows) else -1
            if parent >= 0:
                coupled[parent].append(rows)
            self.below.append(rows)
            self.parents.append(parent)

    @staticmethod
    def of(graph: csr_array, columns: Sequence[Indices]) -> _Tree:
        """From sets of vertices in an order of elimination; it changes where that costs nothing."""
        tree = _Tree(graph, columns)
        order = tree._postorder()
        return tree if order == list(range(len(columns))) else _Tree(graph, [columns[s] for s in order])

    def _postorder(self) -> list[int]:
        children: list[list[int]] = [[] for _ in self.parents]
        for s, parent in enumerate(self.parents):
            if parent >= 0:
                children[parent].append(s)
        order: list[int] = []
        pending = [s for s, parent in enumerate(self.parents) if parent < 0]
        while pending:
            order.append(s := pending.pop())
            pending += children[s]
        return order[::-1]
