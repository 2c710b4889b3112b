"""Motions from files, for a subject."""

from __future__ import annotations

from pathlib import Path

from toile.capture.body.poses import Poses
from toile.capture.body.subject import Subject
from toile.capture.motion.bvh import read_bvh
from toile.capture.motion.gltf import read_gltf_motion
from toile.capture.motion.skeleton_motion import beginning_at_rest, retargeted
from toile.errors import InputError


def load_motion(subject: Subject, file: Path | str, fps: float, frames: int | None = None) -> Poses:
    """A motion from a file, retargeted by the names of the joints; it begins at the subject's pose at rest.

    Args:
        subject: who is to move.
        file: .bvh, .glb or .gltf.
        fps: frames a second of the result.
        frames: how many, with the passage from rest; None for all.

    Raises:
        InputError: no such format, an unreadable file, another skeleton, or fewer frames than asked for.
    """
    match Path(file).suffix.lower():
        case ".bvh":
            motion = read_bvh(file)
        case ".glb" | ".gltf":
            motion = read_gltf_motion(file, fps)
        case suffix:
            raise InputError(
                "Unknown format of a motion",
                where=str(file),
                expected=".bvh, .glb or .gltf",
                got=suffix or "no suffix",
            )
    poses = beginning_at_rest(subject, retargeted(subject, motion, fps), fps)
    if frames is not None and frames > len(poses):
        raise InputError(
            "Motion is too short", where=str(file), expected=f"{frames} frames", got=f"{len(poses)}"
        )
    return poses if frames is None else poses[:frames]
