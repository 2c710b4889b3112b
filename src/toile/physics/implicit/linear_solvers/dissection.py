"""Nested dissection: an elimination order with little fill-in for graphs of surfaces.

A small set of vertices, the separator, cuts the graph into two halves of about the same size; it is
eliminated after both, and each half is treated likewise (George, Nested dissection of a regular finite
element mesh, 1973). A half is what lies below a threshold of a smooth function over the graph, made of
distances from vertices far apart; the separator is the smallest set of vertices that meets every edge between
the sides, by König's theorem.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, maximum_bipartite_matching

Indices = NDArray[np.int64]

# A half has at least this share of the vertices.
_SMALLEST_HALF = 0.35
# Averages over the neighbours, which make whole-numbered distances smooth and their level lines straight.
_SMOOTHING = 8


def nested_dissection(graph: csr_array, leaf: int) -> list[Indices]:
    """Sets of vertices in the order of elimination; no edge leads from a set to one that is no ancestor.

    Args:
        graph: symmetric pattern (N, N) without diagonal.
        leaf: sets up to this size are not divided.
    """
    parts: list[Indices] = []
    # From the last set to the first: a separator, then one half, then the other.
    pending = [(np.arange(graph.shape[0]), graph)]
    while pending:
        vertices, within = pending.pop()
        if len(vertices) <= leaf:
            parts.append(vertices)
            continue
        *halves, separator = _divided(within)
        parts.append(vertices[separator])
        pending += [(vertices[half], _subgraph(within, half)) for half in halves if len(half)]
    return [part for part in reversed(parts) if len(part)]


def _subgraph(graph: csr_array, vertices: Indices) -> csr_array:
    """The edges between some vertices, which get new numbers in the order given."""
    number = np.full(graph.shape[0], -1)
    number[vertices] = np.arange(len(vertices))
    row, column = np.repeat(number, np.diff(graph.indptr)), number[graph.indices]
    kept = (row >= 0) & (column >= 0)
    starts = np.concatenate(
        (np.zeros(1, np.int64), np.cumsum(np.bincount(row[kept], minlength=len(vertices))))
    )
    return csr_array((graph.data[kept], column[kept], starts), shape=(len(vertices), len(vertices)))


def _divided(graph: csr_array) -> tuple[Indices, Indices, Indices]:
    """Two halves without an edge between them, and the separator."""
    n, starts, neighbours = graph.shape[0], graph.indptr[:-1], graph.indices
    start = _distances(graph, 0)
    if (start < 0).any():
        return np.flatnonzero(start >= 0), np.flatnonzero(start < 0), np.zeros(0, np.int64)
    from_a = _distances(graph, int(start.argmax()))
    from_b = _distances(graph, int(from_a.argmax()))
    # A second direction, across the first one: from the vertex farthest from both.
    from_c = _distances(graph, int(np.minimum(from_a, from_b).argmax()))
    from_d = _distances(graph, int(np.where(np.abs(from_a - from_b) <= 1, from_c, -1).argmax()))
    along, across = from_a - from_b, from_c - from_d
    degree = np.diff(graph.indptr)
    lowest = np.inf
    smallest = max(1, int(_SMALLEST_HALF * n))
    sizes = np.arange(smallest, n - smallest + 1)
    for function in (along, across, along + across, along - across):
        smooth = function.astype(np.float64)
        for _ in range(_SMOOTHING):
            smooth = 0.5 * (smooth + np.add.reduceat(smooth[neighbours], starts) / degree)
        order = np.argsort(smooth, kind="stable")
        rank = np.empty(n, np.int64)
        rank[order] = np.arange(n)
        # A vertex below the threshold touches the other side if its highest neighbour is not below.
        highest = np.maximum.reduceat(rank[neighbours], starts)
        least = np.minimum.reduceat(rank[neighbours], starts)
        touching = np.minimum(_covering(rank, highest, n), _covering(least, rank, n))[sizes]
        # Work grows as the third power of the separator; halves of unequal size have larger ones later.
        costs = touching * (1 + (sizes / n - 0.5) ** 2)
        best = int(costs.argmin())
        if costs[best] < lowest:
            lowest, side = float(costs[best]), rank < sizes[best]
    separator = _smallest_cover(graph, side)
    other = ~side
    side[separator] = other[separator] = False
    return np.flatnonzero(side), np.flatnonzero(other), separator


def _covering(low: Indices, high: Indices, n: int) -> Indices:
    """Number of intervals low < t <= high around each t = 0 ... n."""
    there = high > low
    first, after = (np.bincount(end[there] + 1, minlength=n + 2) for end in (low, high))
    return np.cumsum(first - after)


def _distances(graph: csr_array, start: int) -> Indices:
    """Number of edges from a vertex to each; -1 where there is no way."""
    order, before = breadth_first_order(graph, start, directed=True, return_predecessors=True)
    rank = np.zeros(graph.shape[0], np.int64)
    rank[order] = np.arange(len(order))
    came_from = rank[before[order[1:]]]  # never falls
    distances = np.full(graph.shape[0], -1)
    begin, end, distance = 0, 1, 0
    while begin < end:
        distances[order[begin:end]] = distance
        begin, end, distance = end, 1 + int(came_from.searchsorted(end)), distance + 1
    return distances


def _smallest_cover(graph: csr_array, side: NDArray[np.bool_]) -> Indices:
    """The fewest vertices that meet every edge between the two sides (König, by a largest matching)."""
    row, column = np.repeat(np.arange(graph.shape[0]), np.diff(graph.indptr)), graph.indices
    crossing = side[row] & ~side[column]
    left, row = np.unique(row[crossing], return_inverse=True)
    right, column = np.unique(column[crossing], return_inverse=True)
    shape = (len(left), len(right))
    between = csr_array((np.ones(len(row), np.int8), (row, column)), shape=shape)
    partner = maximum_bipartite_matching(between, perm_type="column")
    matched = np.full(len(right), -1)
    matched[partner[partner >= 0]] = np.flatnonzero(partner >= 0)
    # Reached from unmatched vertices on the left: by any edge to the right, by matched edges back.
    on_left, on_right = partner < 0, np.zeros(len(right), np.bool_)
    n_reached = -1
    while n_reached < (n_reached := int(on_left.sum())):
        on_right[column[on_left[row]]] = True
        back = matched[on_right]
        on_left[back[back >= 0]] = True
    return np.union1d(left[~on_left], right[on_right])
