"""A tube around an upright ball: the smallest garment on the smallest body."""

import numpy as np
import torch
import trimesh
from torch import Tensor

from toile.capture.garments.embedding import embed
from toile.capture.garments.garment import Garment, Material


def tube(around: int, along: int, radii: tuple[float, float], heights: tuple[float, float]):
    """Vertices and outward faces of a tube about y, from the upper end down."""
    angle = 2 * np.pi * np.arange(around) / around
    radius, height = np.linspace(*radii, along), np.linspace(*heights, along)
    rings = [
        radius[:, None] * np.cos(angle),
        np.repeat(height[:, None], around, 1),
        -radius[:, None] * np.sin(angle),
    ]
    i = np.arange(along - 1)[:, None] * around + np.arange(around)
    j = np.arange(along - 1)[:, None] * around + (np.arange(around) + 1) % around
    faces = [
        np.stack(corners, -1).reshape(-1, 3) for corners in ((i, i + around, j), (j, i + around, j + around))
    ]
    return torch.from_numpy(np.stack(rings, -1).reshape(-1, 3)), torch.from_numpy(np.concatenate(faces))


def body_and_garment(
    around: int = 16, along: int = 8, radii: tuple[float, float] = (0.106, 0.13), **material: float
) -> tuple[Tensor, Tensor, Garment]:
    """Vertices (V, 3) and faces of an upright capsule, and a tube whose upper ring it holds."""
    mesh = trimesh.creation.capsule(height=0.5, radius=0.1, count=[16, 16])
    mesh = mesh.subdivide()
    body = torch.from_numpy(np.array(mesh.vertices)[:, [1, 2, 0]])
    body = body - body.mean(0)
    faces = torch.from_numpy(np.array(mesh.faces, np.int64))
    vertices, triangles = tube(around, along, radii, (0.05, -0.25))
    held = torch.arange(around)
    fixed = embed(vertices[held], body, faces)
    values = {"young": 200.0, "bending": 1e-5, **material}
    return (
        body,
        faces,
        Garment(vertices, triangles, held, fixed.faces, fixed.barycentric, fixed.offsets, Material(**values)),
    )


def tilted(body: Tensor, angle: float) -> Tensor:
    """Turned about x [rad]."""
    c, s = np.cos(angle), np.sin(angle)
    return body @ torch.tensor([[1.0, 0, 0], [0, c, s], [0, -s, c]], dtype=torch.float64)
