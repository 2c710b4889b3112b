"""Embedded graph of a mesh: few nodes whose rotations and translations deform all of its vertices.

Sumner, Schmid, Pauly: Embedded deformation for shape manipulation, ACM Transactions on Graphics 26(3), 2007;
the embedded graph of Li et al., Deep Physics-aware Inference of Cloth Deformation for Monocular Human
Performance Capture, 3DV 2021, section 3.3.1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toile.capture.body.limits import rotation_of_angles
from toile.capture.body.skinning import linear_blend
from toile.capture.garments.garment import Material
from toile.errors import InputError

INFLUENCES = 4
"""Nodes that move one vertex, as in Sumner et al."""

SKIN_RIGIDITY = 20.0
"""Rigidity of a body's nodes; ours: skin follows its bones, a skirt does not."""


@dataclass(frozen=True)
class EmbeddedGraph:
    """K nodes on a mesh of N vertices, at rest.

    Attributes:
        vertices: (K,) int64; vertices of the mesh that the nodes lie on.
        positions: (K, 3), float64 [m]; where they are at rest.
        indices: (N, k) int64; nodes that move a vertex.
        weights: (N, k), float64; of these nodes, non-negative, rows sum to 1.
        edges: (E, 2) int64; nodes that move a vertex in common, each pair once, the smaller number first.
        rigidity: (E,), float64; how strongly an edge is kept as it is, 1 for the default fabric.
    """

    vertices: Tensor
    positions: Tensor
    indices: Tensor
    weights: Tensor
    edges: Tensor
    rigidity: Tensor

    def __len__(self) -> int:
        return len(self.vertices)


def embedded_graph(
    vertices: Tensor,
    faces: Tensor,
    nodes: int,
    rigidity: float | Tensor = 1.0,
    influences: int = INFLUENCES,
) -> EmbeddedGraph:
    """Choose nodes among the vertices of a mesh, far from each other along it, and weigh them.

    The first node is vertex 0, each further one the vertex farthest from those before, in lengths of paths
    along edges: cloth on one leg is far from cloth on the other, however close they are. A vertex at distance
    d of a node has weight (1 - d / d_max)², d_max its distance to the (k+1)-th nearest node. The same mesh
    gives the same graph.

    Args:
        vertices: of the mesh at rest (N, 3) [m].
        faces: (T, 3).
        nodes: K.
        rigidity: of the whole mesh, or of every vertex (N,); an edge has the mean of its nodes. See
            ``fabric_rigidity`` and ``SKIN_RIGIDITY``.
        influences: k, nodes that move a vertex.

    Raises:
        InputError: more nodes than vertices, fewer than one, or fewer than the mesh has pieces.
    """
    n = len(vertices)
    if not 1 <= nodes <= n:
        raise InputError(
            "Number of graph nodes does not fit the mesh",
            where="nodes",
            expected=f"1 to {n}",
            got=str(nodes),
        )
    chosen, distances = _farthest(vertices.double().numpy(), faces.numpy(), nodes)
    k = min(influences, nodes)
    order = np.argsort(distances, axis=0, kind="stable")
    nearest = order[:k].T
    near = np.take_along_axis(distances.T, nearest, 1)
    reach = np.full(n, np.inf) if nodes == k else np.take_along_axis(distances, order[k : k + 1], 0)[0]
    # A piece with too few nodes for a next one: all of them count.
    farthest = np.where(np.isfinite(near), near, 0.0).max(1)
    reach = np.where(np.isfinite(reach), reach, 2.0 * np.maximum(farthest, 1e-9))
    weights = np.where(np.isfinite(near), np.square(1.0 - np.minimum(near / reach[:, None], 1.0)), 0.0)
    # All nodes equally far: none of them is preferred.
    weights[weights.sum(1) == 0] = np.isfinite(near[weights.sum(1) == 0])
    weights /= weights.sum(1, keepdims=True)
    edges = _pairs(nearest, weights > 0, nodes)
    at = torch.from_numpy(chosen)
    of_vertex = torch.as_tensor(rigidity, dtype=torch.float64).expand(n)
    return EmbeddedGraph(
        vertices=at,
        positions=vertices[at].double(),
        indices=torch.from_numpy(nearest),
        weights=torch.from_numpy(weights),
        edges=torch.from_numpy(edges),
        rigidity=of_vertex[at][torch.from_numpy(edges)].mean(1),
    )


def fabric_rigidity(material: Material) -> float:
    """Rigidity of a fabric's edges, 1 for the default one: its Young's modulus over that one's.

    What an edge is displaced against its node, squared, times the membrane's modulus [N/m] is an energy, so
    fabrics compare as their moduli do. The scale is ours; the paper gives no numbers.
    """
    return material.young / Material().young


def node_rotations(A: Tensor) -> Tensor:
    """Rotations of the nodes' Euler angles, (..., K, 3) [rad] -> (..., K, 3, 3); see ``body.limits.AXES``."""
    return rotation_of_angles(A)


def embedded_deformation(graph: EmbeddedGraph, vertices: Tensor, A: Tensor, T: Tensor) -> Tensor:
    """Vertices moved by the nodes: Σ_k w_k (R_k (v - g_k) + g_k + t_k) (Sumner et al. 2007).

    Args:
        graph: of the mesh.
        vertices: of the mesh at rest (N, 3) [m].
        A: Euler angles of the nodes (..., K, 3) [rad].
        T: translations of the nodes (..., K, 3) [m].

    Returns:
        (..., N, 3) [m], of the type of ``A``.

    Raises:
        InputError: parameters of another graph.
    """
    for name, parameters in (("A", A), ("T", T)):
        if parameters.shape[-2:] != (len(graph), 3) or parameters.shape != A.shape:
            raise InputError(
                "Parameters belong to another embedded graph",
                where=name,
                expected=f"(..., {len(graph)}, 3), A as T",
                got=f"{tuple(parameters.shape)}",
            )
    positions = graph.positions.to(A)
    R = node_rotations(A)
    shift = positions + T - (R @ positions[..., None])[..., 0]
    # Rows 0 to 2 are all that is blended; the last is there because transforms are 4 by 4.
    last = torch.tensor([0.0, 0.0, 0.0, 1.0]).to(A).expand(*A.shape[:-1], 1, 4)
    transforms = torch.cat((torch.cat((R, shift[..., None]), -1), last), -2)
    moved = linear_blend(
        vertices.to(A),
        graph.indices.to(A.device),
        graph.weights.to(A),
        transforms.reshape(-1, len(graph), 4, 4),
    )
    return moved.reshape(*A.shape[:-2], len(vertices), 3)


def _farthest(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], nodes: int
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Nodes (K,) by farthest-point sampling, and lengths of paths from each to every vertex (K, N)."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import dijkstra

    n = len(vertices)
    ends = np.concatenate([faces[:, [a, (a + 1) % 3]] for a in range(3)])
    ends = np.unique(np.sort(ends, 1), axis=0)
    length = np.linalg.norm(vertices[ends[:, 0]] - vertices[ends[:, 1]], axis=1)
    paths = csr_array((length, (ends[:, 0], ends[:, 1])), shape=(n, n))
    chosen = np.zeros(nodes, np.int64)
    distances = np.empty((nodes, n))
    nearest = np.full(n, np.inf)
    for node in range(nodes):
        chosen[node] = 0 if node == 0 else int(nearest.argmax())
        distances[node] = dijkstra(paths, directed=False, indices=int(chosen[node]))
        nearest = np.minimum(nearest, distances[node])
    unreached = np.flatnonzero(np.isinf(nearest))
    if len(unreached):
        raise InputError(
            "Embedded graph has too few nodes for a mesh of several pieces",
            where="nodes",
            expected="at least one per connected piece",
            got=f"{nodes}, and none reaches {len(unreached)} of {n} vertices, the first is {unreached[0]}",
        )
    return chosen, distances


def _pairs(nearest: NDArray[np.int64], used: NDArray[np.bool_], nodes: int) -> NDArray[np.int64]:
    """Pairs of nodes that move a vertex in common (E, 2), sorted."""
    from scipy.sparse import csr_array

    row, column = np.nonzero(used)
    moves = csr_array((np.ones(len(row), np.int64), (row, nearest[row, column])), shape=(len(nearest), nodes))
    first, second = (moves.T @ moves).nonzero()
    pairs = np.column_stack((first, second))[first < second].astype(np.int64)
    return pairs[np.lexsort(pairs.T[::-1])]
