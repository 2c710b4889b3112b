"""Reading motions from BVH files (Biovision hierarchy)."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from toile.capture.motion.skeleton_motion import SkeletonMotion
from toile.errors import InputError

_AXES = {"X": 0, "Y": 1, "Z": 2}


@dataclass
class _Joint:
    name: str
    parent: int
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    channels: list[str] = field(default_factory=list)


def read_bvh(path: Path | str) -> SkeletonMotion:
    """Read skeleton and motion; rotations apply in the order of the channels, angles in degrees.

    Raises:
        InputError: missing, or a line that is none of BVH, with its number.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError("BVH file is missing", where=str(path), expected="a .bvh file", got="no such file")
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    joints, at = _hierarchy(lines, path)
    values, fps = _motion(lines, at, sum(len(joint.channels) for joint in joints), path)
    rest = torch.zeros(len(joints), 3, dtype=torch.float64)
    turns = np.empty((len(values), len(joints), 3, 3))
    positions = np.empty((len(values), len(joints), 3))
    column = 0
    for number, joint in enumerate(joints):
        local, moved = np.tile(np.eye(3), (len(values), 1, 1)), np.zeros((len(values), 3))
        for channel in joint.channels:
            axis = _AXES[channel[0].upper()]
            if channel[1:].lower() == "rotation":
                local = local @ _about(axis, np.deg2rad(values[:, column]))
            else:
                moved[:, axis] = values[:, column]
            column += 1
        offset = torch.tensor(joint.offset, dtype=torch.float64)
        if joint.parent < 0:
            rest[number], turns[:, number] = offset, local
            # Positions of the root replace its offset; without such channels it stays there.
            has_position = any(channel.lower().endswith("position") for channel in joint.channels)
            positions[:, number] = moved if has_position else offset.numpy()
        else:
            rest[number] = rest[joint.parent] + offset
            turns[:, number] = turns[:, joint.parent] @ local
            positions[:, number] = positions[:, joint.parent] + turns[:, joint.parent] @ offset.numpy()
    return SkeletonMotion(
        tuple(joint.name for joint in joints),
        tuple(joint.parent for joint in joints),
        rest,
        torch.from_numpy(turns),
        torch.from_numpy(positions),
        fps,
        str(path),
    )


def _hierarchy(lines: list[str], path: Path) -> tuple[list[_Joint], int]:
    joints: list[_Joint] = []
    # Joints whose braces are open; −1 stands for an end site.
    above: list[int] = []
    following: int | None = None
    for number, line in enumerate(lines):
        words = line.split()
        keyword = words[0].upper() if words else ""
        try:
            match keyword:
                case "" | "HIERARCHY":
                    pass
                case "ROOT" | "JOINT":
                    if (keyword == "ROOT") == bool(above) or (keyword == "ROOT" and joints):
                        raise ValueError("one ROOT, and JOINTs inside it")
                    joints.append(_Joint(" ".join(words[1:]), above[-1] if above else -1))
                    following = len(joints) - 1
                case "END":
                    following = -1
                case "{":
                    if following is None:
                        raise ValueError("a brace that opens nothing")
                    above.append(following)
                    following = None
                case "}":
                    above.pop()
                case "OFFSET":
                    x, y, z = map(float, words[1:4])
                    if above[-1] >= 0:
                        joints[above[-1]].offset = (x, y, z)
                case "CHANNELS":
                    channels = words[2:]
                    known = all(c[:1].upper() in _AXES and c[1:].lower() in _KINDS for c in channels)
                    if int(words[1]) != len(channels) or not known:
                        raise ValueError("channels are X, Y or Z, and position or rotation")
                    joints[above[-1]].channels = channels
                case "MOTION":
                    if above or not joints:
                        raise ValueError("braces that are not closed, or no joint")
                    return joints, number + 1
                case _:
                    raise ValueError("no keyword of BVH")
        except (ValueError, IndexError) as error:
            raise _unreadable(path, number, line, error) from error
    raise InputError(
        "BVH file has no motion", where=str(path), expected="a line MOTION", got=f"{len(lines)} lines without"
    )


_KINDS = ("position", "rotation")


def _motion(lines: list[str], at: int, channels: int, path: Path) -> tuple[np.ndarray, float]:
    frames, interval, rows = None, None, []
    for number, line in enumerate(lines[at:], start=at):
        words = line.replace(":", ": ").split()
        try:
            if not words:
                continue
            if words[0].lower() == "frames:":
                frames = int(words[1])
            elif words[:2] and words[0].lower() == "frame":
                interval = float(words[2])
                if not interval > 0:
                    raise ValueError("a frame time above 0")
            else:
                row = [float(word) for word in words]
                if len(row) != channels or not np.isfinite(row).all():
                    raise ValueError(f"{channels} finite numbers, got {len(row)}")
                rows.append(row)
        except (ValueError, IndexError) as error:
            raise _unreadable(path, number, line, error) from error
    if frames is None or interval is None or not rows or len(rows) != frames:
        raise InputError(
            "BVH motion is incomplete",
            where=str(path),
            expected="'Frames: n', 'Frame Time: seconds' and n lines of numbers",
            got=f"{frames} frames named, frame time {interval}, {len(rows)} lines",
        )
    return np.array(rows), 1.0 / interval


def _about(axis: int, angle: np.ndarray) -> np.ndarray:
    """Rotations about an axis, (F,) -> (F, 3, 3)."""
    matrix = np.zeros((len(angle), 3, 3))
    a, b = (axis + 1) % 3, (axis + 2) % 3
    matrix[:, axis, axis] = 1.0
    matrix[:, a, a] = matrix[:, b, b] = np.cos(angle)
    matrix[:, b, a] = np.sin(angle)
    matrix[:, a, b] = -np.sin(angle)
    return matrix


def _unreadable(path: Path, number: int, line: str, error: Exception) -> InputError:
    return InputError(
        "BVH line cannot be read",
        where=f"{path}, line {number + 1}",
        expected="HIERARCHY with ROOT, JOINT, End Site, OFFSET, CHANNELS; MOTION with numbers",
        got=f"{line.strip()[:80]!r} ({error})",
    )
