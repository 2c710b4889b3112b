"""Fixing vertices of a garment to faces of the body."""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
import torch
from torch import Tensor

from toile.capture.garments.garment import face_frames


@dataclass(frozen=True)
class Embedding:
    """Points given on a triangle mesh, and beside it.

    Attributes:
        faces: (A,), int64; the face closest to each point.
        barycentric: (A, 3); the closest point of that face.
        offsets: (A, 3) [m]; from there to the point, in the face's frame.
    """

    faces: Tensor
    barycentric: Tensor
    offsets: Tensor


def embed(points: Tensor, vertices: Tensor, faces: Tensor, allowed: Tensor | None = None) -> Embedding:
    """Fix points to the closest faces of a mesh.

    Args:
        points: (A, 3).
        vertices: (V, 3).
        faces: (T, 3).
        allowed: mask (T,) of the faces to choose from, e.g. not those of the arms.
    """
    index = torch.arange(len(faces)) if allowed is None else allowed.nonzero().ravel()
    _, nearest, closest = igl.point_mesh_squared_distance(
        points.numpy(), vertices.numpy(), np.ascontiguousarray(faces[index].numpy())
    )
    chosen = index[torch.from_numpy(np.asarray(nearest, dtype=np.int64).ravel())]
    corners = [np.ascontiguousarray(vertices[faces[chosen, corner]].numpy()) for corner in range(3)]
    barycentric = torch.from_numpy(np.asarray(igl.barycentric_coordinates(closest, *corners)))
    base = (vertices[faces[chosen]] * barycentric[..., None]).sum(1)
    frames = face_frames(vertices, faces[chosen])
    offsets = (frames.mT @ (points - base)[..., None])[..., 0]
    return Embedding(chosen, barycentric, offsets)
