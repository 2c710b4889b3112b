"""Limits of the joints: angles of flexion, abduction and twist, and rotations brought back within them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import roma
import torch
from torch import Tensor

from toile.capture.body.humanoid import humanoid_joints
from toile.capture.body.poses import Poses, from_world_axes, in_world_axes
from toile.capture.body.subject import Subject

AXES = "XZY"
"""Order of the angles: intrinsic, about the world's x (to the left of the subject), z (forward), y (up)."""

# Degrees, ours, after what textbooks of physiotherapy give for adults. Angles about x are positive backward
# for what hangs down (legs) and forward for what stands up (spine, neck, head); those about z are positive to
# the left for what hangs down: abduction of the left leg. Arms have wide limits, because the three angles say
# little for a limb that stands off at rest.
_DEGREES: Mapping[str, tuple[tuple[float, float], ...]] = {
    "spine": ((-20, 40), (-20, 20), (-25, 25)),
    "chest": ((-15, 30), (-15, 15), (-25, 25)),
    "upper_chest": ((-15, 30), (-15, 15), (-25, 25)),
    "neck": ((-45, 45), (-35, 35), (-50, 50)),
    "head": ((-25, 25), (-15, 15), (-30, 30)),
    "left_upper_leg": ((-120, 30), (-30, 45), (-45, 45)),
    "left_lower_leg": ((0, 140), (-5, 5), (-10, 10)),
    "left_foot": ((-25, 50), (-20, 20), (-25, 25)),
    "left_upper_arm": ((-170, 60), (-75, 130), (-90, 90)),
    "left_lower_arm": ((-145, 60), (-145, 145), (-90, 90)),
    "left_hand": ((-80, 80), (-40, 40), (-40, 40)),
}


def human_limits(joint_names: Sequence[str]) -> Tensor:
    """Limits of the joints of a human skeleton, by their names.

    Args:
        joint_names: J names; joints without a role have no limits.

    Returns:
        (J, 3, 2), float64 [rad].
    """
    limits = torch.tensor([-math.inf, math.inf], dtype=torch.float64).repeat(len(joint_names), 3, 1)
    for role, index in humanoid_joints(joint_names).items():
        degrees = _DEGREES.get(role)
        if degrees is None and role.startswith("right_"):
            # Mirrored at the plane between left and right: angles about y and z change their sign.
            x, z, y = _DEGREES.get(role.replace("right_", "left_"), ((-math.inf, math.inf),) * 3)
            degrees = (x, (-z[1], -z[0]), (-y[1], -y[0]))
        if degrees is not None:
            limits[index] = torch.deg2rad(torch.tensor(degrees, dtype=torch.float64))
    return limits


def joint_angles(subject: Subject, poses: Poses) -> Tensor:
    """Flexion, abduction and twist of every joint, (F, J, 3) [rad]."""
    angles: Tensor = roma.rotmat_to_euler(AXES, in_world_axes(subject, poses))
    return angles


def rotation_of_angles(angles: Tensor) -> Tensor:
    """Rotations in the world's axes of flexion, abduction, twist: (..., 3) [rad] -> (..., 3, 3)."""
    rotation: Tensor = roma.euler_to_rotmat(AXES, angles)
    return rotation


def beyond_limits(subject: Subject, poses: Poses) -> Tensor:
    """By how much each angle is out of its limits, (F, J, 3) [rad]; 0 within."""
    angles = joint_angles(subject, poses)
    low, high = subject.joint_limits.unbind(-1)
    return torch.maximum((low - angles).clamp(min=0), (angles - high).clamp(min=0))


def within_limits(subject: Subject, poses: Poses) -> Poses:
    """Poses whose angles are moved to the closest limit where they are beyond it."""
    if not bool((beyond_limits(subject, poses) > 0).any()):
        return poses
    angles = joint_angles(subject, poses)
    low, high = subject.joint_limits.unbind(-1)
    world = in_world_axes(subject, poses)
    outside = ((angles < low) | (angles > high)).any(-1)
    world = torch.where(
        outside[..., None, None], rotation_of_angles(torch.maximum(torch.minimum(angles, high), low)), world
    )
    return from_world_axes(subject, world, poses.root_translation)
