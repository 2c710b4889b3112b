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
    both = torch.cat((real, 0.5 * roma.quat_product(shift, real)), -1)
    blended = _dense(indices, weights, transforms.shape[1]) @ both
    strongest = indices.gather(1, weights.argmax(1, keepdim=True))
    opposed = (real @ real.mT < 0).nonzero()
    if len(opposed):
        # Few vertices have joints of opposed quaternions: they alone are summed with signs.
        frame, vertex = _meet(opposed, indices, weights, strongest, len(transforms))
        of, own = real[frame[:, None], indices[vertex]], real[frame, strongest[vertex, 0]]
        sign = torch.where((of * own[:, None]).sum(-1) < 0, -1.0, 1.0).to(weights.dtype)
        blended[frame, vertex] = (
            (sign * weights[vertex])[..., None] * both[frame[:, None], indices[vertex]]
        ).sum(1)
    unit, dual = (blended / blended[..., :4].norm(dim=-1, keepdim=True)).split(4, dim=-1)
    # 2 dual conjugate(real): the vector part is the translation, the scalar part is what the normalisation of
    # the dual part would take away.
    vector, scalar = unit[..., :3], unit[..., 3:]
    translation = 2 * (
        scalar * dual[..., :3] - dual[..., 3:] * vector + torch.linalg.cross(vector, dual[..., :3])
    )
    turn = 2 * torch.linalg.cross(vector, vertices.expand_as(vector))
    return vertices + scalar * turn + torch.linalg.cross(vector, turn) + translation


def _meet(
    opposed: Tensor, indices: Tensor, weights: Tensor, strongest: Tensor, frames: int
) -> tuple[Tensor, Tensor]:
    """Frames and vertices where a joint is opposed to the vertex's strongest one; ``opposed`` (P, 3)."""
    pairs = torch.zeros(frames, int(indices.max()) + 1, int(indices.max()) + 1, dtype=torch.bool)
    inside = (opposed[:, 1:] < pairs.shape[1]).all(1)
    pairs[tuple(opposed[inside].T)] = True
    found = []
    for frame in opposed[:, 0].unique().tolist():
        at = (pairs[frame][strongest, indices] & (weights > 0)).any(1).nonzero()[:, 0]
        found.append(torch.stack((torch.full_like(at, frame), at)))
    frame, vertex = torch.cat(found, 1)
    return frame, vertex


METHODS: Mapping[str, Blend] = {"dual_quaternion": dual_quaternion_blend, "linear": linear_blend}
"""Blends by name."""


def _dense(indices: Tensor, weights: Tensor, joints: int) -> Tensor:
    """Weights as a matrix (V, J): one product with it is quicker than gathering nine transforms a vertex."""
    dense = torch.zeros(len(indices), joints, dtype=weights.dtype)
    return dense.scatter_add_(1, indices, weights)
