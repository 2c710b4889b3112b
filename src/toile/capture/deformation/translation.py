"""Where in the world a root-relative person is: global translation from 2D landmarks, in closed form.

Habermann et al., DeepCap, CVPR 2020, global alignment; used by Li et al. 2021, sections 3.3 and 4.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from toile.errors import InputError
from toile.geometry.camera import Camera


def along_world(camera: Camera, points: Tensor) -> Tensor:
    """Points of camera- and root-relative space in the axes of the world, still root-relative; (..., 3)."""
    return points @ camera.R.to(points)


def global_translation(
    landmarks: Tensor, cameras: Sequence[Camera], detections: Tensor, confidences: Tensor | None = None
) -> Tensor:
    """Translation that brings landmarks closest to the rays of their pixels.

    Minimises Σ_c Σ_m σ_cm ‖(I - d dᵀ)(K_m + t - o_c)‖² by t, d the unit ray of pixel p_cm and o_c the centre
    of camera c: a linear system of three equations per frame. One camera is enough, because a person has a
    size; then the depth is what the size of the prediction says. Differentiable by landmarks and detections.

    Args:
        landmarks: K, root-relative, in the axes of the world (B, L, 3) [m].
        cameras: C of them.
        detections: p (B, C, L, 2) [px]; anything where the confidence is 0.
        confidences: σ (B, C, L), non-negative; all 1 if None.

    Returns:
        t (B, 3) [m], the place of the root joint in the world.

    Raises:
        InputError: shapes that do not fit, or a frame with fewer than two landmarks that were seen.
    """
    expected = (len(landmarks), len(cameras), landmarks.shape[1])
    sigma = torch.ones(expected).to(landmarks) if confidences is None else confidences.to(landmarks)
    if detections.shape != (*expected, 2) or sigma.shape != expected:
        raise InputError(
            "2D landmarks do not fit",
            where="detections, confidences",
            expected=f"{(*expected, 2)}, {expected}",
            got=f"{tuple(detections.shape)}, {tuple(sigma.shape)}",
        )
    seen = (sigma > 0).sum((1, 2))
    if bool((seen < 2).any()):
        frame = int((seen < 2).nonzero()[0, 0])
        raise InputError(
            "Too few 2D landmarks to place a person",
            where=f"frame {frame}",
            expected="at least two with a confidence above 0",
            got=str(int(seen[frame])),
        )
    matrix = landmarks.new_zeros(len(landmarks), 3, 3)
    right = landmarks.new_zeros(len(landmarks), 3)
    for c, camera in enumerate(cameras):
        pixels = torch.where(sigma[:, c, :, None] > 0, detections[:, c].to(landmarks), 0.0)
        flat = torch.stack(
            ((pixels[..., 0] - camera.cx) / camera.fx, (pixels[..., 1] - camera.cy) / camera.fy), -1
        )
        ray = torch.cat((flat, torch.ones_like(flat[..., :1])), -1) @ camera.R.to(landmarks)
        ray = torch.nn.functional.normalize(ray, dim=-1)
        across = torch.eye(3).to(landmarks) - ray[..., :, None] * ray[..., None, :]
        across = sigma[:, c, :, None, None] * across
        matrix = matrix + across.sum(1)
        right = right + (across @ (camera.centre.to(landmarks) - landmarks)[..., None])[..., 0].sum(1)
    return torch.linalg.solve(matrix, right)
