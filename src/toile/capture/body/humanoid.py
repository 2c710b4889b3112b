"""Which joint of a skeleton is the left knee: roles of a human skeleton by the usual names."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

ROLES: Mapping[str, tuple[str, ...]] = {
    "hips": ("hips", "hip", "pelvis", "root"),
    "spine": ("spine05", "spine", "spine1", "lowerback", "abdomen", "torso"),
    "chest": ("spine03", "spine1", "spine2", "chest"),
    "upper_chest": ("spine01", "spine2", "spine3", "upperchest", "chest2"),
    "neck": ("neck01", "neck", "neck1"),
    "head": ("head",),
    "left_shoulder": ("clavicle.l", "leftshoulder", "leftcollar", "lcollar", "clavicle_l"),
    "left_upper_arm": (
        "upperarm01.l",
        "leftarm",
        "leftupperarm",
        "lshldr",
        "upperarm_l",
        "leftshoulderjoint",
    ),
    "left_lower_arm": ("lowerarm01.l", "leftforearm", "leftlowerarm", "lforearm", "lowerarm_l", "leftelbow"),
    "left_hand": ("wrist.l", "lefthand", "lhand", "hand_l", "leftwrist"),
    "left_upper_leg": ("upperleg01.l", "leftupleg", "leftupperleg", "lthigh", "thigh_l", "lefthip"),
    "left_lower_leg": ("lowerleg01.l", "leftleg", "leftlowerleg", "lshin", "calf_l", "leftknee"),
    "left_foot": ("foot.l", "leftfoot", "lfoot", "foot_l", "leftankle"),
    "left_toes": ("toe1-1.l", "lefttoebase", "lefttoes", "lefttoe", "ball_l"),
}
"""Names of the left side and the middle, in the skeletons of MakeHuman, Mixamo, CMU, DAZ and Unreal; those of
the right side follow from them."""

_SIDES = ((".l", ".r"), ("_l", "_r"), ("left", "right"))


def humanoid_joints(names: Sequence[str]) -> dict[str, int]:
    """Index of the joint of every role that is found.

    Args:
        names: of the joints; prefixes such as ``mixamorig:`` and capital letters do not matter.

    Returns:
        ``{"hips": 0, "left_upper_leg": 12, ...}``; a role that no name fits is left out, and one joint has at
        most one role.
    """
    plain = {_plain(name): index for index, name in reversed(list(enumerate(names)))}
    found: dict[str, int] = {}
    for role, aliases in _all_roles().items():
        for alias in aliases:
            index = plain.get(alias)
            if index is not None and index not in found.values():
                found[role] = index
                break
    return found


def _plain(name: str) -> str:
    return re.sub(r"[\s\-]+", "", name.rpartition(":")[2].rpartition("|")[2].lower())


def _all_roles() -> dict[str, tuple[str, ...]]:
    roles = {role: tuple(map(_plain, names)) for role, names in ROLES.items()}
    for role, names in list(roles.items()):
        if role.startswith("left_"):
            roles[role.replace("left_", "right_")] = tuple(map(_right, names))
    return roles


def _right(name: str) -> str:
    for left, right in _SIDES:
        if left in name:
            return name.replace(left, right)
    return "r" + name[1:]
