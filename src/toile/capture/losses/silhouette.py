"""Multi-view silhouette loss on distance transforms, with the normal test ρ (Li et al. 2021, Eq. 5).

After Habermann et al., LiveCap, ACM Transactions on Graphics 38(2), 2019, and DeepCap, CVPR 2020.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from toile.capture.layer.silhouette import Outline
from toile.errors import InputError
from toile.geometry.camera import Camera
from toile.geometry.moving_surface import MovingSurface
from toile.physics.topology import Topology


@dataclass(frozen=True)
class Boundary:
    """Vertices that the outline of a mesh goes through, as one camera sees it: B_c.

    Attributes:
        vertices: (M,) int64; a vertex may be there twice, with the background on both sides.
        outward: (M, 3) unit vectors in the world, across the ray to the vertex, towards the background.
    """

    vertices: Tensor
    outward: Tensor


class BoundaryFinder:
    """Finds the boundary vertices of a garment on a body in every camera.

    By the same test as Eq. 1 in the simulation layer: the surface turns away from the eye there, or ends, and
    a ray that passes by meets neither garment nor body.

    Args:
        faces: of the garment (T, 3).
        n_vertices: N, of the garment.
        body_faces: all of them, also those of the arms, which hide the background as well (Fb, 3).
        n_body: V, vertices of the body.
    """

    def __init__(self, faces: Tensor, n_vertices: int, body_faces: Tensor, n_body: int) -> None:
        self._body = MovingSurface(n_body, body_faces.numpy())
        self._outline = Outline(Topology(n_vertices, faces), self._body)

    def __call__(self, garment: Tensor, body: Tensor, cameras: Sequence[Camera]) -> list[Boundary]:
        """Boundary in each camera; no gradients.

        Args:
            garment: in the world (N, 3) [m].
            body: in the world (V, 3) [m].
            cameras: C of them.
        """
        self._body.move(body.detach().double().cpu().numpy())
        self._outline.move(garment.detach().double().cpu().numpy())
        found = [self._outline.of(camera.centre.numpy()) for camera in cameras]
        return [
            Boundary(torch.from_numpy(vertices).to(garment.device), torch.from_numpy(outward).to(garment))
            for vertices, outward in found
        ]


def distance_field(mask: Tensor) -> Tensor:
    """Signed distance D_c of pixel centres to the outline of a mask: negative inside, positive outside.

    The outline runs between pixels, half a pixel from the centres on both sides of it. The border of the
    image is no outline: a person that is cut off there ends elsewhere.

    Args:
        mask: of the person (H, W) bool.

    Returns:
        (H, W), float64 [px]; 0 everywhere for a mask without outline, which so draws nothing.
    """
    inside = mask.numpy()
    if inside.all() or not inside.any():
        return torch.zeros(inside.shape, dtype=torch.float64)
    signed = np.where(inside, 0.5 - distance_transform_edt(inside), distance_transform_edt(~inside) - 0.5)
    return torch.from_numpy(signed)


def alignment(slope: Tensor, outward: Tensor) -> Tensor:
    """Normal test ρ: cosine of the boundary's normal in the image and ∇D, 0 where they point apart.

    ∇D of the signed distance points out of the person on both sides of the outline, and so does the normal of
    the boundary. Where they point apart, the nearest outline is that of another side of the person, and the
    vertex must not be drawn there. Where D has no slope (halfway between two outlines), nothing is said.

    Args:
        slope: ∇D, of length 1 or less (..., 2).
        outward: unit normals in the image (..., 2).

    Returns:
        (...), from 0 to 1.
    """
    return (slope * outward).sum(-1).clamp(0.0, 1.0)


def silhouette_loss(
    vertices: Tensor,
    boundaries: Sequence[Sequence[Boundary]],
    cameras: Sequence[Camera],
    fields: Tensor | Sequence[Sequence[Tensor]],
) -> Tensor:
    """L_sil = Σ_c Σ_{b∈B_c} ρ_cb D_c(Π_c(V_b))², mean over frames.

    ρ and the choice of the boundary have no gradients. What projects out of the image has ρ = 0.

    Args:
        vertices: V in the world (B, N, 3) [m].
        boundaries: of every frame and camera, B times C.
        cameras: C of them.
        fields: D of every frame and camera (B, C, H, W) [px], see ``distance_field``.

    Returns:
        Scalar [px²].

    Raises:
        InputError: other numbers of frames or cameras.
    """
    if len(boundaries) != len(vertices) or len(fields) != len(vertices):
        raise InputError(
            "Silhouettes do not fit",
            where="boundaries, fields",
            expected=f"{len(vertices)} frames",
            got=f"{len(boundaries)}, {len(fields)}",
        )
    total = vertices.new_zeros(())
    for frame, (seen, distances) in enumerate(zip(boundaries, fields, strict=True)):
        for camera, boundary, field in zip(cameras, seen, distances, strict=True):
            total = total + _of_view(vertices[frame], boundary, camera, field.to(vertices))
    return total / len(vertices)


def _of_view(vertices: Tensor, boundary: Boundary, camera: Camera, field: Tensor) -> Tensor:
    """One summand over c."""
    with torch.no_grad():
        place = camera.from_world(vertices[boundary.vertices])
        seen = camera.project(vertices[boundary.vertices])
        size = seen.new_tensor([camera.width, camera.height])
        within = ((seen >= 0) & (seen <= size)).all(-1) & (place[:, 2] > 0)
        place, pixels = place[within], seen[within]
        turned = boundary.outward[within].to(place) @ camera.R.T.to(place)
        # Derivative of the projection along ``outward``, but for a positive factor.
        across = turned[:, :2] - place[:, :2] / place[:, 2:] * turned[:, 2:]
        normal = torch.nn.functional.normalize(across * across.new_tensor([camera.fx, camera.fy]), dim=-1)
        step = torch.eye(2).to(pixels)
        ahead, behind = (_sample(field, pixels[:, None] + sign * step) for sign in (1, -1))
        rho = alignment((ahead - behind) / 2, normal)
    # Projected again, with gradients, where the image says something only.
    pixels = camera.project(vertices[boundary.vertices[within]])
    return (rho * _sample(field, pixels).square()).sum()


def _sample(field: Tensor, pixels: Tensor) -> Tensor:
    """Values (...) of a field (H, W) at pixels (..., 2), bilinear, continued beyond the border."""
    size = pixels.new_tensor([field.shape[1], field.shape[0]])
    grid = (2 * pixels / size - 1).reshape(1, 1, -1, 2)
    values = torch.nn.functional.grid_sample(
        field[None, None], grid, mode="bilinear", padding_mode="border", align_corners=False
    )
    return values.reshape(pixels.shape[:-1])
