"""Angular error of surface normals, against true vertices or against a point cloud."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from toile.evaluation.point_to_surface import closest_points
from toile.geometry.mesh import face_normals, vertex_normals

VERTEX_NORMAL_PROTOCOL = (
    "mean angle between reconstructed and true area-weighted vertex normals, oriented (0 to 180), degrees; "
    "mean over all frames"
)
CLOUD_NORMAL_PROTOCOL = (
    "mean angle between the normal of the ground-truth cloud (PCA of the {neighbours} nearest points) and "
    "the normal of the closest reconstructed triangle, unoriented (0 to 90), degrees; at {samples} seeded "
    "ground-truth points per frame; mean over all frames"
)


def vertex_normal_error(vertices: Tensor, true_vertices: Tensor, faces: Tensor) -> Tensor:
    """Angle between vertex normals of two meshes of the same topology.

    Args:
        vertices: reconstruction (..., V, 3) [m].
        true_vertices: ground truth (..., V, 3) [m].
        faces: triangles (T, 3).

    Returns:
        Angle per vertex (..., V) in [0, 180] [deg], float64.
    """
    a = vertex_normals(vertices.detach().cpu().double(), faces.cpu())
    b = vertex_normals(true_vertices.detach().cpu().double(), faces.cpu())
    # atan2 of the half-angle lengths stays accurate where acos loses half the digits (near 0 and 180
    # degrees).
    return torch.rad2deg(2.0 * torch.atan2((a - b).norm(dim=-1), (a + b).norm(dim=-1)))


def cloud_normals(cloud: Tensor, points: Tensor, neighbours: int) -> npt.NDArray[np.float64]:
    """Unoriented unit normals of a point cloud at ``points``, by PCA of the nearest cloud points.

    Args:
        cloud: point cloud (n, 3) [m].
        points: where to estimate (m, 3) [m].
        neighbours: how many nearest cloud points enter the PCA, at least 3.

    Returns:
        Eigenvector of the smallest eigenvalue of the neighbours' covariance, (m, 3).
    """
    c = cloud.detach().cpu().double().numpy()
    _, index = cKDTree(c).query(points.detach().cpu().double().numpy(), k=min(neighbours, len(c)), workers=1)
    local = c[index] - c[index].mean(axis=1, keepdims=True)
    _, vectors = np.linalg.eigh(np.einsum("mki,mkj->mij", local, local))
    normals: npt.NDArray[np.float64] = vectors[:, :, 0]
    return normals


def cloud_normal_error(
    vertices: Tensor, faces: Tensor, cloud: Tensor, *, seed: int, samples: int = 2000, neighbours: int = 50
) -> float:
    """Mean unoriented angle [deg] between cloud normals and the normals of the closest triangles, one frame.

    With 50 neighbours the PCA reaches about 16 mm around a point of the published scans (30,000 points on
    0.3 m²), which averages the depth noise of the sensor and still resolves a fold of a 32×32 grid.

    Args:
        vertices: reconstruction (V, 3) [m].
        faces: triangles (T, 3).
        cloud: ground-truth cloud (n, 3) [m].
        seed: seed of the choice of ground-truth points.
        samples: how many ground-truth points are used (all, where there are fewer).
        neighbours: neighbours of the PCA.
    """
    generator = torch.Generator().manual_seed(seed)
    chosen = cloud[torch.randperm(len(cloud), generator=generator)[:samples]]
    expected = cloud_normals(cloud, chosen, neighbours)
    closest = closest_points(chosen, vertices, faces)
    normals = face_normals(vertices.detach().cpu().double(), faces.cpu()).numpy()[closest.face]
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    along = np.abs(np.einsum("mi,mi->m", normals, expected))
    across = np.linalg.norm(np.cross(normals, expected), axis=1)
    return float(np.degrees(np.arctan2(across, along)).mean())
