"""Poses of a skeleton over time, and its forward kinematics."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from toile.capture.body.subject import Subject
from toile.errors import InputError


@dataclass(frozen=True)
class Poses:
    """F poses of one skeleton.

    Attributes:
        rotations: (F, J, 3, 3), float64; rotation of each joint against its rest pose, in the joint's own
            frame at rest (identity is the rest pose).
        root_translation: (F, 3), float64 [m]; of the root joint, added to where it is at rest.
    """

    rotations: Tensor
    root_translation: Tensor

    def __post_init__(self) -> None:
        frames = len(self.root_translation)
        if self.rotations.shape != (frames, self.rotations.shape[1], 3, 3) or self.root_translation.shape != (
            frames,
            3,
        ):
            raise InputError(
                "Poses have the wrong shape",
                where="poses",
                expected="rotations (F, J, 3, 3), root_translation (F, 3)",
                got=f"{tuple(self.rotations.shape)}, {tuple(self.root_translation.shape)}",
            )

    def __len__(self) -> int:
        return len(self.root_translation)

    def __getitem__(self, frames: slice) -> Poses:
        return Poses(self.rotations[frames], self.root_translation[frames])


def rest_poses(subject: Subject, frames: int = 1) -> Poses:
    """The subject at rest."""
    joints = len(subject.joint_names)
    return Poses(
        torch.eye(3, dtype=torch.float64).repeat(frames, joints, 1, 1),
        torch.zeros(frames, 3, dtype=torch.float64),
    )


def from_world_axes(subject: Subject, rotations: Tensor, root_translation: Tensor) -> Poses:
    """Poses of rotations that are given about the axes of the world at rest.

    Args:
        subject: whose skeleton.
        rotations: (F, J, 3, 3); of a joint relative to its parent, as it would be written if every joint's
            frame at rest were parallel to the world.
        root_translation: (F, 3) [m].
    """
    frames = subject.rest_joints[:, :3, :3]
    return Poses(frames.mT @ rotations @ frames, root_translation)


def in_world_axes(subject: Subject, poses: Poses) -> Tensor:
    """Inverse of ``from_world_axes``: (F, J, 3, 3)."""
    frames = subject.rest_joints[:, :3, :3]
    return frames @ poses.rotations @ frames.mT


def posed_joints(subject: Subject, poses: Poses) -> Tensor:
    """Pose of every joint's frame in the world, (F, J, 4, 4).

    Raises:
        InputError: poses of another skeleton.
    """
    joints = len(subject.joint_names)
    if poses.rotations.shape[1] != joints:
        raise InputError(
            "Poses belong to another skeleton",
            where="poses",
            expected=f"{joints} joints",
            got=f"{poses.rotations.shape[1]} joints",
        )
    rest = subject.rest_joints
    local = rest.clone()
    local[1:] = torch.linalg.inv(rest[subject.parents[1:]]) @ rest[1:]
    turned = torch.eye(4, dtype=rest.dtype).repeat(len(poses), joints, 1, 1)
    turned[:, :, :3, :3] = poses.rotations
    step = local @ turned
    step[:, 0, :3, 3] += poses.root_translation
    world: list[Tensor] = [step[:, 0]]
    for joint, parent in enumerate(subject.parents[1:].tolist(), start=1):
        world.append(world[parent] @ step[:, joint])
    return torch.stack(world, 1)


def joint_transforms(subject: Subject, poses: Poses) -> Tensor:
    """What moves a point at rest that is fixed to a joint to where it is posed, (F, J, 4, 4)."""
    return posed_joints(subject, poses) @ torch.linalg.inv(subject.rest_joints)
