"""Skinning weights of a garment, from the body below it."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from toile.capture.body.subject import INFLUENCES, Subject
from toile.capture.garments.embedding import embed
from toile.capture.garments.garment import Garment
from toile.geometry.mesh import face_normals

SMOOTHING = 0.1
"""Length over which weights are evened out along the cloth [m]; ours."""


def garment_skinning(
    garment: Garment, subject: Subject, smoothing: float = SMOOTHING
) -> tuple[Tensor, Tensor]:
    """Weights of the nearest points of the body, evened out along the cloth.

    Between the legs the nearest point jumps from one to the other, and a skirt with such weights is torn
    apart at a step. So the weights w diffuse: (M + s² L) w = M w₀, L the cotangent Laplacian, M the areas of
    the vertices, s the length. Faces of the arms are left out: hands hang beside a skirt that they do not
    move (they are not in contact either).

    Args:
        garment: worn by the subject at rest.
        subject: with its own weights.
        smoothing: s [m]; 0 for none.

    Returns:
        Joints (N, 9) int64 and weights (N, 9) float64, rows sum to 1.
    """
    arms = subject.parts["arms"]
    below = embed(garment.rest_vertices, subject.rest_vertices, subject.faces, ~arms[subject.faces].any(1))
    corners = subject.faces[below.faces]
    share = below.barycentric[..., None] * subject.skinning_weights[corners]
    dense = torch.zeros(len(corners), len(subject.joint_names), dtype=torch.float64)
    dense.scatter_add_(1, subject.skinning_indices[corners].flatten(1), share.flatten(1))
    if smoothing > 0:
        dense = _diffused(dense, garment, smoothing)
    weights, indices = dense.sort(dim=1, descending=True, stable=True)
    weights, indices = weights[:, :INFLUENCES], indices[:, :INFLUENCES]
    return indices.contiguous(), weights / weights.sum(1, keepdim=True)


def _diffused(weights: Tensor, garment: Garment, length: float) -> Tensor:
    """Weights (N, J) evened out along the garment."""
    import igl
    from scipy.sparse import csr_array, diags_array
    from scipy.sparse.linalg import splu

    faces = garment.faces
    third = face_normals(garment.rest_vertices, faces).norm(dim=-1) / 6
    areas = torch.zeros(len(weights), dtype=torch.float64)
    for corner in range(3):
        areas.index_add_(0, faces[:, corner], third)
    laplacian = igl.cotmatrix(garment.rest_vertices.numpy(), np.ascontiguousarray(faces.numpy()))
    system = csr_array(diags_array(areas.numpy()) - length**2 * laplacian)
    used = (weights > 0).any(0).nonzero().ravel()
    smooth = weights.clone()
    fixed = torch.zeros(len(weights), dtype=torch.bool)
    fixed[garment.attached] = True
    # A loose vertex that no face uses has no equation.
    free = (~fixed & (areas > 0)).nonzero().ravel()
    rows = system[free.numpy()]
    right = areas[free, None] * weights[free][:, used]
    right -= torch.from_numpy(rows[:, fixed.numpy()] @ weights[fixed][:, used].numpy())
    found = splu(rows[:, free.numpy()].tocsc()).solve(right.numpy())
    smooth[free[:, None], used] = torch.from_numpy(found)
    # Obtuse triangles may give a little less than nothing.
    return smooth.clamp(min=0)
