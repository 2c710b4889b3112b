"""The body that carries the garment: as it was estimated, with a pose or a shape that is a little wrong."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import replace

import roma
import torch
from torch import Tensor

from toile.capture.body.humanoid import humanoid_joints
from toile.capture.body.poses import Poses, from_world_axes, in_world_axes
from toile.capture.body.skinning import skin
from toile.capture.body.subject import Subject
from toile.errors import InputError
from toile.geometry.mesh import vertex_normals

_SIDES = ("left", "right")
_FADE = 0.1
"""Height over which a wider skin begins, so that it has no step [m]."""


class EstimatedBody(ABC):
    """Vertices of the body in every frame, as a function of what may be wrong with them."""

    @abstractmethod
    def moved(self, thigh: float, girth: float) -> Tensor:
        """With thighs turned and the skin of hips and legs shifted.

        Args:
            thigh: turn of both thighs forwards, about the hips, in their own frame [rad].
            girth: along the normals [m].

        Returns:
            (F, V, 3) [m].
        """


class PosedBody(EstimatedBody):
    """A subject whose poses are known: errors are made at rest, and skinning takes them along.

    Args:
        subject: who.
        poses: F of them.
        top: height of the waistband at rest, above which the skin stays [m].

    Raises:
        InputError: the skeleton has no legs.
    """

    def __init__(self, subject: Subject, poses: Poses, top: float) -> None:
        self.subject, self.poses = subject, poses
        self._thighs = thighs_of(subject)
        rest = subject.rest_vertices
        self._skin_moves = lower_body(subject, top)[:, None] * vertex_normals(rest, subject.faces)

    def moved(self, thigh: float, girth: float) -> Tensor:
        """See EstimatedBody."""
        rotations = in_world_axes(self.subject, self.poses)
        turn = _forwards(thigh)
        # Grows out of the pose at rest, as the motion does.
        for joint in self._thighs:
            rotations[:, joint] = rotations[:, joint] @ turn
        poses = from_world_axes(self.subject, rotations, self.poses.root_translation)
        rest = self.subject.rest_vertices + girth * self._skin_moves
        return skin(replace(self.subject, rest_vertices=rest), poses)


class TrackedBody(EstimatedBody):
    """A subject of whom only vertices are known: the frames of the thighs are found from them.

    To first order in the errors it is what ``PosedBody`` does with linear blending.

    Args:
        subject: who; its weights say which vertices a thigh takes along.
        positions: vertices in every frame (F, V, 3) [m].
        top: height of the waistband at rest, above which the skin stays [m].

    Raises:
        InputError: another number of vertices than the subject's, or the skeleton has no legs.
    """

    def __init__(self, subject: Subject, positions: Tensor, top: float) -> None:
        rest = subject.rest_vertices
        if positions.ndim != 3 or positions.shape[1:] != rest.shape:
            raise InputError(
                "Body is not the subject's",
                where="body_positions",
                expected=f"shape (F, {len(rest)}, 3)",
                got=str(tuple(positions.shape)),
            )
        self._positions = positions.double()
        faded = lower_body(subject, top)[:, None]
        self._skin_moves = torch.stack([faded * vertex_normals(x, subject.faces) for x in self._positions])
        joints = humanoid_joints(subject.joint_names)
        self._legs = []
        for joint, side in zip(thighs_of(subject), _SIDES, strict=True):
            whole = _weight_of(subject, _below(subject, joint))
            lower = _weight_of(subject, _below(subject, joints[f"{side}_lower_leg"]))
            rigid = whole - lower > 0.9
            rotations, shifts = roma.rigid_points_registration(
                rest[rigid].expand(len(positions), -1, -1), self._positions[:, rigid]
            )
            hip = rotations @ subject.rest_joints[joint, :3, 3] + shifts
            self._legs.append((whole[:, None], rotations, hip[:, None]))

    def moved(self, thigh: float, girth: float) -> Tensor:
        """See EstimatedBody."""
        x = self._positions + girth * self._skin_moves
        moved = x
        for weight, rotations, hip in self._legs:
            turn = rotations @ _forwards(thigh) @ rotations.mT - torch.eye(3, dtype=torch.float64)
            moved = moved + weight * ((x - hip) @ turn.mT)
        return moved


def lower_body(subject: Subject, top: float) -> Tensor:
    """Hips and legs: 1 below the waistband but for the arms, 0 above, faded in between (V,)."""
    rest = subject.rest_vertices
    low = (rest[:, 1] < top) & ~subject.parts["arms"]
    return ((top - rest[:, 1]) / _FADE).clamp(0.0, 1.0) * low


def thighs_of(subject: Subject) -> tuple[int, ...]:
    """Joints of both thighs.

    Raises:
        InputError: the skeleton has none.
    """
    joints = humanoid_joints(subject.joint_names)
    needed = [f"{side}_{part}_leg" for side in _SIDES for part in ("upper", "lower")]
    missing = [role for role in needed if role not in joints]
    if missing:
        raise InputError(
            "Skeleton has no such joints",
            where="subject",
            expected=", ".join(needed),
            got=f"no {', '.join(missing)}",
        )
    return tuple(joints[f"{side}_upper_leg"] for side in _SIDES)


def _forwards(angle: float) -> Tensor:
    return roma.rotvec_to_rotmat(torch.tensor([-angle, 0.0, 0.0], dtype=torch.float64))


def _below(subject: Subject, joint: int) -> Tensor:
    """A joint and all that hang on it, bool (J,)."""
    found = torch.zeros(len(subject.joint_names), dtype=torch.bool)
    found[joint] = True
    for child, parent in enumerate(subject.parents.tolist()):
        if parent >= 0 and bool(found[parent]):
            found[child] = True
    return found


def _weight_of(subject: Subject, joints: Tensor) -> Tensor:
    """Share of some joints in every vertex (V,)."""
    return (subject.skinning_weights * joints[subject.skinning_indices]).sum(1)
