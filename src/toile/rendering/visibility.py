"""Which points of a mesh the camera sees, from what the rasterizer found."""

from __future__ import annotations

import torch
from torch import Tensor

from toile.errors import InputError
from toile.geometry.camera import Camera
from toile.rendering.base import NEAR, Fragments


def visible_points(
    fragments: Fragments,
    vertices: Tensor,
    faces: Tensor,
    camera: Camera,
    point_faces: Tensor,
    point_barycentrics: Tensor,
    tolerance: float = 1e-3,
) -> Tensor:
    """Tell which points on a mesh are inside the image and not hidden by the mesh.

    A point is hidden if the face that its pixel shows passes more than ``tolerance`` in front of it. That
    face's depth is taken at the point's own projection, not at the pixel centre, so a slanted cloth does not
    hide itself.

    Args:
        fragments: what ``Renderer.rasterize`` returned for these vertices, faces and camera.
        vertices: (B, V, 3) [m].
        faces: (T, 3), int64.
        camera: the camera of ``fragments``.
        point_faces: face on which each point lies (P,), int64.
        point_barycentrics: its barycentric coordinates on that face (P, 3).
        tolerance: depth [m] within which two surfaces count as one.

    Returns:
        (B, P), bool.

    Raises:
        InputError: shapes do not fit together.
    """
    shape = (vertices.shape[0], camera.height, camera.width)
    if fragments.face.shape != shape:
        raise InputError(
            "fragments of another image",
            where="fragments.face",
            expected=f"shape (B, h, w) = {shape}",
            got=str(tuple(fragments.face.shape)),
        )
    if point_faces.ndim != 1 or point_barycentrics.shape != (*point_faces.shape, 3):
        raise InputError(
            "points do not fit together",
            where="point_faces, point_barycentrics",
            expected="shapes (P,) and (P, 3)",
            got=f"{tuple(point_faces.shape)} and {tuple(point_barycentrics.shape)}",
        )
    vertices = camera.from_world(vertices.detach().double())
    weights = point_barycentrics.to(vertices)
    points = (vertices[:, faces[point_faces]] * weights[..., None]).sum(-2)  # (B, P, 3)
    in_front = points[..., 2] > NEAR
    points = torch.where(in_front[..., None], points, torch.ones_like(points))

    pixel = camera.at_origin().project(points)
    column, row = pixel.floor().unbind(-1)
    inside = in_front & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    frame = torch.arange(len(vertices), device=vertices.device)[:, None]
    hit = fragments.face[
        frame, row.clamp(0, camera.height - 1).long(), column.clamp(0, camera.width - 1).long()
    ]
    # Depth of the hit face where the ray through the point meets its plane n · x = n · a.
    a, b, c = vertices[frame[..., None], faces[hit.clamp(min=0)]].unbind(-2)
    normal = torch.linalg.cross(b - a, c - a)
    along_ray = (normal * points).sum(-1) / points[..., 2]
    depth = (normal * a).sum(-1) / along_ray
    hidden = (hit >= 0) & (hit != point_faces) & (depth < points[..., 2] - tolerance)
    return inside & ~hidden
