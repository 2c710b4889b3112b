"""Multi-view landmark loss (Li et al. 2021, Eq. 4)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from toile.errors import InputError
from toile.geometry.camera import Camera


def landmark_loss(
    landmarks: Tensor, cameras: Sequence[Camera], detections: Tensor, confidences: Tensor | None = None
) -> Tensor:
    """L_lm = Σ_c Σ_m σ_cm ‖Π_c(K_m) - p_cm‖², mean over frames.

    The paper has no σ; with all of them 1 this is its equation.

    Args:
        landmarks: K in the world (B, L, 3) [m], in front of every camera.
        cameras: C of them.
        detections: p (B, C, L, 2) [px]; anything, NaN too, where the confidence is 0.
        confidences: σ (B, C, L), non-negative; all 1 if None.

    Returns:
        Scalar [px²].

    Raises:
        InputError: shapes that do not fit.
    """
    expected = (len(landmarks), len(cameras), landmarks.shape[1])
    if detections.shape != (*expected, 2) or (confidences is not None and confidences.shape != expected):
        raise InputError(
            "2D landmarks do not fit",
            where="detections, confidences",
            expected=f"{(*expected, 2)}, {expected}",
            got=f"{tuple(detections.shape)}, {None if confidences is None else tuple(confidences.shape)}",
        )
    projected = torch.stack([camera.project(landmarks) for camera in cameras], 1)
    if confidences is None:
        return (projected - detections.to(projected)).square().sum((1, 2, 3)).mean()
    seen = (confidences > 0)[..., None]
    away = torch.where(seen, projected - torch.where(seen, detections.to(projected), 0.0), 0.0)
    return (confidences.to(projected)[..., None] * away.square()).sum((1, 2, 3)).mean()
