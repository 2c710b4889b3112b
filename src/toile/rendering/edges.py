"""Edges of a triangle mesh, with the faces on either side: what the antialias stage looks along."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class MeshEdges:
    """Unique edges of a mesh, in ascending order of their vertex indices.

    Attributes:
        vertices: the two ends (E, 2), int64, lower index first.
        opposite: the third vertex of each adjacent face (E, 2), int64; the second is -1 on the border of
            the mesh. Where more than two faces share an edge, the first two count.
    """

    vertices: Tensor
    opposite: Tensor


def mesh_edges(faces: Tensor) -> MeshEdges:
    """Collect the unique edges of ``faces`` (T, 3)."""
    ends = torch.cat((faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]])).sort(dim=1).values
    third = torch.cat((faces[:, 2], faces[:, 0], faces[:, 1]))
    vertices, index = torch.unique(ends, dim=0, return_inverse=True)
    order = torch.argsort(index, stable=True)
    count = torch.bincount(index, minlength=len(vertices))
    first = count.cumsum(0) - count
    third = third[order]
    second = torch.where(count > 1, third[(first + 1).clamp(max=max(len(third) - 1, 0))], -1)
    return MeshEdges(vertices, torch.stack((third[first], second), dim=1))
