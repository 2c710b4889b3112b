"""Triangle meshes: grid triangulation, normals, area-weighted sampling."""

from __future__ import annotations

import torch
from torch import Tensor


def grid_faces(height: int, width: int) -> Tensor:
    """Triangles of an H×W vertex grid, two per quad, consistently oriented; shape (2(H-1)(W-1), 3), int64.

    Vertex (i, j) has index i * W + j.
    """
    index = torch.arange(height * width).reshape(height, width)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    return torch.stack((torch.stack((a, b, c), -1), torch.stack((a, c, d), -1)), 2).reshape(-1, 3)


def face_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """Face normals of length twice the triangle area; vertices (..., V, 3), faces (T, 3) -> (..., T, 3)."""
    p = vertices[..., faces, :]
    return torch.linalg.cross(p[..., 1, :] - p[..., 0, :], p[..., 2, :] - p[..., 0, :])


def vertex_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """Unit vertex normals, area-weighted over the faces around each vertex; (..., V, 3) -> (..., V, 3)."""
    normals = face_normals(vertices, faces)
    total = torch.zeros_like(vertices)
    for corner in range(3):
        total = total.index_add(-2, faces[:, corner], normals)
    return torch.nn.functional.normalize(total, dim=-1)


def sample_surface(vertices: Tensor, faces: Tensor, n: int, generator: torch.Generator) -> Tensor:
    """Draw ``n`` points uniformly by area from a triangle mesh; vertices (V, 3) -> (n, 3), seeded."""
    area = face_normals(vertices, faces).norm(dim=-1)
    face = torch.multinomial(area.double(), n, replacement=True, generator=generator)
    r = torch.rand(n, 2, dtype=vertices.dtype, generator=generator)
    # Square root maps the unit square uniformly onto the triangle (Osada et al. 2002).
    s = r[:, :1].sqrt()
    weights = torch.cat((1 - s, s * (1 - r[:, 1:]), s * r[:, 1:]), dim=1)
    return (weights[:, :, None] * vertices[faces[face]]).sum(1)
