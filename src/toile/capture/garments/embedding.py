"""Fixing vertices of a garment to faces of the body."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from toile.capture.garments.garment import face_frames
from toile.geometry.surface import nearest_points


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
    if not len(points):
        return Embedding(torch.empty(0, dtype=torch.int64), points.reshape(0, 3), points.reshape(0, 3))
    index = torch.arange(len(faces)) if allowed is None else allowed.nonzero().ravel()
    among = np.ascontiguousarray(faces[index].numpy())
    nearest, _ = nearest_points(points.numpy(), vertices.numpy(), among)
    # The point knows the corners of its face; its number is where these stand.
    number = {tuple(face): k for k, face in enumerate(among.tolist())}
    chosen = index[torch.tensor([number[tuple(face)] for face in nearest.faces.tolist()])]
    barycentric = torch.from_numpy(np.asarray(nearest.weights, dtype=np.float64))
    base = (vertices[faces[chosen]] * barycentric[..., None]).sum(1)
    frames = face_frames(vertices, faces[chosen])
    offsets = (frames.mT @ (points - base)[..., None])[..., 0]
    return Embedding(chosen, barycentric, offsets)
