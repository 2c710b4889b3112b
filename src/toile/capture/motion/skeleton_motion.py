"""A motion of whatever skeleton a file has, and its transfer to a subject."""

from __future__ import annotations

import math
from dataclasses import dataclass

import roma
import torch
from torch import Tensor

from toile.capture.body.humanoid import humanoid_joints
from toile.capture.body.poses import Poses, from_world_axes, rest_poses
from toile.capture.body.skinning import skin
from toile.capture.body.subject import Subject
from toile.errors import InputError

_NEEDED = ("hips", "left_upper_leg", "right_upper_leg", "left_lower_leg", "right_lower_leg")

# Limbs whose direction at rest may differ between skeletons (arms of a T-pose and an A-pose), and their ends.
_LIMBS = {
    f"{side}_{limb}": f"{side}_{end}"
    for side in ("left", "right")
    for limb, end in (
        ("upper_arm", "lower_arm"),
        ("lower_arm", "hand"),
        ("upper_leg", "lower_leg"),
        ("lower_leg", "foot"),
        ("foot", "toes"),
    )
}


@dataclass(frozen=True)
class SkeletonMotion:
    """A motion as a file has it.

    Attributes:
        joint_names: J names.
        parents: of the joints, −1 for the root; parents before children.
        rest: position of every joint at rest (J, 3), float64, in the units and axes of the file.
        turns: what each joint's frame has turned by since rest, about the axes of the file's world,
            (F, J, 3, 3).
        positions: of the joints (F, J, 3), in the units of the file.
        fps: frames a second.
        where: file, for messages.
    """

    joint_names: tuple[str, ...]
    parents: tuple[int, ...]
    rest: Tensor
    turns: Tensor
    positions: Tensor
    fps: float
    where: str


def retargeted(subject: Subject, motion: SkeletonMotion, fps: float) -> Poses:
    """Poses of a subject that moves as another skeleton does; joints are found by their names.

    The axes are those in which both stand upright and face the same way at rest; lengths are scaled by the
    height of the hips over the feet. Limbs point where those of the file point, so that it does not matter
    whether it rests in a T-pose or an A-pose. The lowest point of the motion is on the floor.

    Args:
        subject: who is to move.
        motion: from a file.
        fps: frames a second of the result.

    Raises:
        InputError: joints of the one or the other have none of the usual names.
    """
    source, target = humanoid_joints(motion.joint_names), humanoid_joints(subject.joint_names)
    for roles, where, names in (
        (source, motion.where, motion.joint_names),
        (target, "subject", subject.joint_names),
    ):
        missing = [role for role in _NEEDED if role not in roles]
        if missing:
            raise InputError(
                "Skeleton cannot be matched by the names of its joints",
                where=where,
                expected=f"joints for {', '.join(missing)}",
                got=", ".join(names[:12]) + (" ..." if len(names) > 12 else ""),
            )
    shared = [role for role in target if role in source]
    ours = subject.rest_joints[:, :3, 3]
    # From the axes of the file to those in which the subject stands.
    axes = _stance(ours, target) @ _stance(motion.rest, source).mT
    rest = motion.rest @ axes.mT
    turns = axes @ motion.turns @ axes.mT
    scale = _hip_height(ours, target) / _hip_height(rest, source)
    wanted: dict[int, Tensor] = {}
    for role in shared:
        turn = turns[:, source[role]]
        end = _LIMBS.get(role)
        if end is not None and end in source and end in target:
            turn = turn @ _rotation_between(
                ours[target[end]] - ours[target[role]], rest[source[end]] - rest[source[role]]
            )
        wanted[target[role]] = turn
    world = torch.eye(3, dtype=torch.float64).repeat(len(turns), len(subject.joint_names), 1, 1)
    reached: list[Tensor] = []
    for joint, parent in enumerate(subject.parents.tolist()):
        above = torch.eye(3, dtype=torch.float64).expand(len(turns), 3, 3) if parent < 0 else reached[parent]
        reached.append(wanted.get(joint, above))
        world[:, joint] = above.mT @ reached[joint]
    root = scale * (motion.positions[:, source["hips"]] @ axes.mT)
    translation = root - root[:1] * torch.tensor([1.0, 0.0, 1.0], dtype=torch.float64)
    translation[:, 1] -= ours[target["hips"], 1]
    poses = resampled(from_world_axes(subject, world, translation), motion.fps, fps)
    lowest = min(
        float(skin(subject, poses[k : k + 8], "linear")[..., 1].min()) for k in range(0, len(poses), 8)
    )
    poses.root_translation[:, 1] -= lowest
    return poses


def resampled(poses: Poses, fps: float, new_fps: float) -> Poses:
    """The same motion at another frame rate; rotations are interpolated along the shortest arc.

    Args:
        poses: F poses.
        fps: of these.
        new_fps: of the result, which covers the same time.
    """
    if len(poses) < 2 or math.isclose(fps, new_fps, rel_tol=1e-6):
        return poses
    count = int((len(poses) - 1) * new_fps / fps + 1e-9) + 1
    at = torch.arange(count, dtype=torch.float64) * fps / new_fps
    low = at.long().clamp(max=len(poses) - 2)
    return _between(
        Poses(poses.rotations[low], poses.root_translation[low]),
        Poses(poses.rotations[low + 1], poses.root_translation[low + 1]),
        at - low,
    )


def beginning_at_rest(subject: Subject, poses: Poses, fps: float, seconds: float = 0.5) -> Poses:
    """The motion after a passage from the pose at rest, where a garment begins without intersection.

    Args:
        subject: who moves.
        poses: F poses.
        fps: frames a second.
        seconds: of the passage, which is put before the motion.
    """
    count = max(1, round(seconds * fps))
    x = torch.arange(count, dtype=torch.float64) / count
    share = x**3 * (10 - 15 * x + 6 * x * x)
    first = Poses(poses.rotations[:1].expand(count, -1, -1, -1), poses.root_translation[:1].expand(count, -1))
    passage = _between(rest_poses(subject, count), first, share)
    return Poses(
        torch.cat((passage.rotations, poses.rotations)),
        torch.cat((passage.root_translation, poses.root_translation)),
    )


def _between(a: Poses, b: Poses, share: Tensor) -> Poses:
    start, end = roma.rotmat_to_unitquat(a.rotations), roma.rotmat_to_unitquat(b.rotations)
    # q and -q are the same rotation: the shorter way is taken.
    end = torch.where((start * end).sum(-1, keepdim=True) < 0, -end, end)
    turn = roma.rotmat_to_rotvec(a.rotations.mT @ b.rotations)
    rotations = a.rotations @ roma.rotvec_to_rotmat(share[:, None, None] * turn)
    move = a.root_translation + share[:, None] * (b.root_translation - a.root_translation)
    return Poses(rotations, move)


def _stance(joints: Tensor, roles: dict[str, int]) -> Tensor:
    """Axes to the left, up and forward of a skeleton at rest, as columns."""
    left = joints[roles["left_upper_leg"]] - joints[roles["right_upper_leg"]]
    feet = 0.5 * (joints[roles["left_lower_leg"]] + joints[roles["right_lower_leg"]])
    up = joints[roles["hips"]] - feet
    # Upright is one of the file's axes: knees that are bent at rest do not tilt the world.
    main = int(up.abs().argmax())
    up = torch.zeros(3, dtype=torch.float64).index_fill(0, torch.tensor(main), float(up[main].sign()))
    left = torch.nn.functional.normalize(left - (left @ up) * up, dim=0)
    return torch.stack((left, up, torch.linalg.cross(left, up)), -1)


def _hip_height(joints: Tensor, roles: dict[str, int]) -> float:
    ends = [roles.get(f"{side}_foot", roles[f"{side}_lower_leg"]) for side in ("left", "right")]
    hips = [roles[f"{side}_upper_leg"] for side in ("left", "right")]
    return float((joints[hips] - joints[ends]).norm(dim=1).mean())


def _rotation_between(a: Tensor, b: Tensor) -> Tensor:
    """Smallest rotation that turns the direction of ``a`` to that of ``b``; (3, 3)."""
    a, b = torch.nn.functional.normalize(a, dim=0), torch.nn.functional.normalize(b, dim=0)
    axis = torch.linalg.cross(a, b)
    angle = torch.atan2(axis.norm(), a @ b)
    if float(axis.norm()) < 1e-9:
        return torch.eye(3, dtype=torch.float64)
    rotation: Tensor = roma.rotvec_to_rotmat(angle * axis / axis.norm())
    return rotation
