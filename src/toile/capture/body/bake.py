"""A subject out of ``anny``, the parametric body model (Brégier et al. 2025; code Apache-2.0, data CC0).

Only its own topology is used, never that of SMPL-X, whose data are for non-commercial use only. Making the
model for the first time takes minutes and writes a cache of 0.8 GB: a subject is baked into a file once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from scipy.optimize import nnls
from torch import Tensor

from toile.capture.body.humanoid import humanoid_joints
from toile.capture.body.limits import human_limits
from toile.capture.body.subject import INFLUENCES, Subject
from toile.errors import InputError
from toile.limits import Fraction
from toile.warp_runtime import start_warp

# From anny's axes (z up, facing −y) to ours (y up, facing +z); the left side is +x in both.
_TO_WORLD = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]], dtype=torch.float64)


@dataclass(frozen=True)
class AnnyBody:
    """One person of the model; the defaults are the subject that comes with the package.

    Attributes:
        gender: 0 male, 1 female.
        age: 0 a baby, 1/3 a child, 2/3 a young adult, 1 old.
        muscle: 0 to 1.
        weight: 0 to 1.
        height: 0 to 1.
        proportions: 0 to 1, ideal.
    """

    gender: Fraction = 1.0
    age: Fraction = 0.67
    muscle: Fraction = 0.5
    weight: Fraction = 0.4
    height: Fraction = 0.5
    proportions: Fraction = 0.7

    def make(self) -> Subject:
        """Bake it; see ``bake_anny``."""
        return bake_anny(self)


def bake_anny(person: AnnyBody) -> Subject:
    """Bake one person, standing on the floor in the A-pose of the model.

    Args:
        person: its phenotype.

    Raises:
        InputError: ``anny`` is not installed.
    """
    try:
        import anny
    except ImportError as error:
        raise InputError(
            "The body model anny is not installed",
            where="toile subject",
            expected="pip install 'toile[subjects]'",
            got=str(error),
        ) from error
    # anny starts Warp with its banner where it is not running.
    start_warp()
    model: Any = anny.Anny()
    with torch.no_grad():
        rest = model(phenotype_kwargs=asdict(person))
    vertices = rest["rest_vertices"][0].double() @ _TO_WORLD.T
    floor = torch.tensor([0.0, float(vertices[:, 1].min()), 0.0], dtype=torch.float64)
    joints = rest["rest_bone_poses"][0].double().clone()
    joints[:, :3] = _TO_WORLD @ joints[:, :3]
    joints[:, :3, 3] -= floor
    indices, weights = most_influential(model.vertex_bone_indices.long(), model.vertex_bone_weights.double())
    names = tuple(model.bone_labels)
    parents = torch.tensor(model.bone_parents, dtype=torch.int64)
    regressor = anny.KeypointsRegressor.coco(model)
    landmark_indices, landmark_weights = sparse_landmarks(
        regressor.regression_weights.double(), vertices - floor, indices, weights, len(names)
    )
    return Subject(
        rest_vertices=vertices - floor,
        faces=model.faces.long(),
        joint_names=names,
        parents=parents,
        rest_joints=joints,
        skinning_indices=indices,
        skinning_weights=weights,
        landmark_names=tuple(regressor.labels),
        landmark_indices=landmark_indices,
        landmark_weights=landmark_weights,
        parts=body_parts(names, parents, indices, weights),
        joint_limits=human_limits(names),
    )


def body_parts(names: Sequence[str], parents: Tensor, indices: Tensor, weights: Tensor) -> dict[str, Tensor]:
    """Masks of the vertices by the limb that their strongest joint belongs to.

    Args:
        names: of the J joints.
        parents: (J,).
        indices: joints of each vertex (V, K).
        weights: of these (V, K).

    Returns:
        "arms", "left_arm", "right_arm", "left_leg", "right_leg", "head" and "torso", the rest; those
        whose joint has no role are empty.
    """
    roles = humanoid_joints(names)
    strongest = indices.gather(1, weights.argmax(1, keepdim=True))[:, 0]
    starts = {
        "left_arm": "left_upper_arm",
        "right_arm": "right_upper_arm",
        "left_leg": "left_upper_leg",
        "right_leg": "right_upper_leg",
        "head": "neck",
    }
    masks = {}
    for part, role in starts.items():
        below = torch.zeros(len(names), dtype=torch.bool)
        if role in roles:
            below[roles[role]] = True
            for joint in range(len(names)):
                parent = int(parents[joint])
                below[joint] |= parent >= 0 and bool(below[parent])
        masks[part] = below[strongest]
    arms = masks["left_arm"] | masks["right_arm"]
    return {"arms": arms, **masks, "torso": ~torch.stack(list(masks.values())).any(0)}


def sparse_landmarks(
    regressor: Tensor, vertices: Tensor, indices: Tensor, weights: Tensor, joints: int
) -> tuple[Tensor, Tensor]:
    """The same landmarks from few vertices.

    Where linear blending puts a mean of vertices depends on four sums for each joint alone: that of the
    weights, and of the weighted positions. Non-negative weights of few vertices that give the same sums give
    the same landmark in every pose (Carathéodory: one vertex a sum is enough).

    Args:
        regressor: dense weights (L, V), rows sum to 1.
        vertices: at rest (V, 3).
        indices: joints of each vertex (V, K).
        weights: of these (V, K).
        joints: J.

    Returns:
        Indices (L, k) and weights (L, k), padded by zeros.
    """
    dense = torch.zeros(len(vertices), joints, dtype=weights.dtype).scatter_add_(1, indices, weights)
    homogeneous = torch.cat((vertices, torch.ones_like(vertices[:, :1])), 1)
    chosen: list[Tensor] = []
    values: list[Tensor] = []
    for row in regressor:
        some = row.nonzero().ravel()
        sums = (dense[some, :, None] * homogeneous[some, None, :]).flatten(1)
        solution, _ = nnls(sums.T.numpy(), (row[some] @ sums).numpy(), maxiter=100 * len(some))
        kept = np.flatnonzero(solution > 1e-9)
        chosen.append(some[kept])
        values.append(torch.from_numpy(solution[kept] / solution[kept].sum()))
    padded = [torch.nn.utils.rnn.pad_sequence(each, batch_first=True) for each in (chosen, values)]
    return padded[0], padded[1]


def most_influential(indices: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """The nine strongest joints of each vertex, their weights made to sum to 1; padded by zeros."""
    kept = min(INFLUENCES, weights.shape[1])
    weights, order = weights.topk(kept, dim=1)
    indices = indices.gather(1, order)
    padding = (0, INFLUENCES - kept)
    weights = torch.nn.functional.pad(weights, padding)
    total = weights.sum(1, keepdim=True)
    normalised = torch.where(total > 0, weights / total, weights)
    return torch.nn.functional.pad(indices, padding), normalised
