"""Skinning of a subject: linear blending, and dual quaternions (Kavan et al. 2007)."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import roma
import torch
from torch import Tensor

from toile.capture.body.poses import Poses, joint_transforms
from toile.capture.body.subject import Subject
from toile.errors import InputError

Blend = Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]

# Vertices times frames that are blended at once: bounds the memory to some hundred megabytes.
_CHUNK = 200_000


def skin(subject: Subject, poses: Poses, method: str = "dual_quaternion") -> Tensor:
    """Positions of the vertices in every pose.

    Args:
        subject: whom to pose.
        poses: F poses of its skeleton.
        method: "dual_quaternion" or "linear".

    Returns:
        (F, V, 3), float64 [m].

    Raises:
        InputError: unknown method, or poses of another skeleton.
    """
    if method not in METHODS:
        raise InputError("Unknown skinning method", where="method", expected=", ".join(METHODS), got=method)
    transforms = joint_transforms(subject, poses)
    blend = METHODS[method]
    at_once = max(1, _CHUNK // len(subject.rest_vertices))
    return torch.cat(
        [
            blend(subject.rest_vertices, subject.skinning_indices, subject.skinning_weights, some)
            for some in transforms.split(at_once)
        ]
    )


def linear_blend(vertices: Tensor, indices: Tensor, weights: Tensor, transforms: Tensor) -> Tensor:
    """Blend the transforms themselves: collapses where joints twist.

    Args:
        vertices: at rest (V, 3).
        indices: joints of each vertex (V, K).
        weights: of these joints (V, K), rows sum to 1.
        transforms: from rest to posed (F, J, 4, 4), rigid.

    Returns:
        (F, V, 3).
    """
    dense = _dense(indices, weights, transforms.shape[1])
    blended = (dense @ transforms[:, :, :3, :].flatten(2)).unflatten(2, (3, 4))
    return torch.einsum("fvij,vj->fvi", blended[..., :3], vertices) + blended[..., 3]


def dual_quaternion_blend(vertices: Tensor, indices: Tensor, weights: Tensor, transforms: Tensor) -> Tensor:
    """Blend unit dual quaternions and normalise the sum, so that every vertex moves rigidly.

    Kavan, Collins, Žára, O'Sullivan: Skinning with dual quaternions, I3D 2007. q and −q are the same
    rotation: each is taken with the sign that points the way of the vertex's strongest joint.

    Args:
        vertices: at rest (V, 3).
        indices: joints of each vertex (V, K).
        weights: of these joints (V, K), rows sum to 1.
        transforms: from rest to posed (F, J, 4, 4), rigid.

    Returns:
        (F, V, 3).
    """
    real = roma.rotmat_to_unitquat(transforms[:, :, :3, :3])
    shift = torch.cat((transforms[:, :, :3, 3], torch.zeros_like(real[..., :1])), -1)
    dual = 0.5 * roma.quat_product(shift, real)
    strongest = indices.gather(1, weights.argmax(1, keepdim=True))
    real_of, pivot = real[:, indices], real[:, strongest]
    sign = torch.where((real_of * pivot).sum(-1) < 0, -1.0, 1.0).to(weights.dtype)
    signed = (sign * weights)[..., None]
    blended_real = (signed * real_of).sum(-2)
    blended_dual = (signed * dual[:, indices]).sum(-2)
    length = blended_real.norm(dim=-1, keepdim=True)
    unit, dual_unit = blended_real / length, blended_dual / length
    # 2 dual * conjugate(real); its vector part is the translation, its scalar part, which a sum of unit dual
    # quaternions may have, is what the normalisation of the dual part would remove.
    translation = 2 * roma.quat_product(dual_unit, roma.quat_conjugation(unit))[..., :3]
    return roma.quat_action(unit, vertices.expand(*unit.shape[:-1], 3)) + translation


METHODS: Mapping[str, Blend] = {"dual_quaternion": dual_quaternion_blend, "linear": linear_blend}
"""Blends by name."""


def _dense(indices: Tensor, weights: Tensor, joints: int) -> Tensor:
    """Weights as a matrix (V, J): one product with it is quicker than gathering nine transforms a vertex."""
    dense = torch.zeros(len(indices), joints, dtype=weights.dtype)
    return dense.scatter_add_(1, indices, weights)
