"""Attachment of a garment to the body (Li et al. 2021, Eq. 6)."""

from __future__ import annotations

from torch import Tensor


def attachment_loss(garment: Tensor, attached: Tensor, targets: Tensor) -> Tensor:
    """L_att = Σ_{i∈A} ‖V_cloth,i - Σ_j γ_ij C(V_cloth,i, V_body)_j‖², mean over frames.

    The point at barycentric coordinates γ of the body's triangle is ``attached_targets``; it stands off the
    skin as far as the anchor did at rest, which the paper's (offset 0) does not.

    Args:
        garment: V_cloth (B, N, 3) [m].
        attached: the anchors, (A,) int64.
        targets: where the body holds them (B, A, 3) [m]; differentiable too, for a body that is not given.

    Returns:
        Scalar [m²].
    """
    return (garment[:, attached] - targets).square().sum((1, 2)).mean()
