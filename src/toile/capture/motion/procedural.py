"""Motions made by formulas: walk, turn, squat, kick, twirl, arm swings."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import roma
import torch
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d
from torch import Tensor

from toile.capture.body.humanoid import humanoid_joints
from toile.capture.body.limits import rotation_of_angles, within_limits
from toile.capture.body.poses import Poses, from_world_axes, joint_transforms
from toile.capture.body.skinning import linear_blend
from toile.capture.body.subject import Subject
from toile.errors import InputError

Floats = npt.NDArray[np.float64]

SETTLE = 0.5
"""Time over which a motion grows out of the pose at rest [s]."""

SIDES = (("left", 1.0), ("right", -1.0))

# Joint angles over a stride that begins with the heel's strike, in degrees; the numbers are ours, the shape
# of the curves is that of normal gait (Winter, Biomechanics and Motor Control of Human Movement): share of
# the stride, flexion of hip and knee, plantar flexion.
_HIP = ((0.0, 26), (0.12, 22), (0.5, -9), (0.62, 0), (0.85, 28), (1.0, 26))
_KNEE = ((0.0, 5), (0.14, 17), (0.4, 6), (0.6, 36), (0.72, 56), (0.9, 12), (1.0, 5))
_ANKLE = ((0.0, 0), (0.08, 5), (0.42, -9), (0.62, 16), (0.8, -1), (1.0, 0))


@dataclass
class Track:
    """What a motion asks for, before it is fitted to a skeleton.

    Attributes:
        time: of the frames (F,) [s].
        angles: flexion, abduction, twist of a role (F, 3) in degrees, added to the pose at rest; signs as in
            ``toile.capture.body.limits``. Those of "hips" turn the whole body.
        turn: of the whole body about the vertical (F,) [rad].
        support: share of the weight on the left foot (F,); that foot stays on the floor.
        stands: whether the feet that bear the weight also stay where they are, horizontally.
        sway: of the hips to the left (F,) [m], where they are free.
    """

    time: Floats
    angles: dict[str, Floats] = field(default_factory=dict)
    turn: Floats = field(default_factory=lambda: np.zeros(0))
    support: Floats = field(default_factory=lambda: np.zeros(0))
    stands: bool = True
    sway: Floats = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        self.turn, self.sway = np.zeros_like(self.time), np.zeros_like(self.time)
        self.support = np.full_like(self.time, 0.5)

    def add(
        self, role: str, flexion: Floats | float = 0, abduction: Floats | float = 0, twist: Floats | float = 0
    ) -> None:
        """Add angles in degrees; those of a right limb are given as for the left, mirrored."""
        mirror = -1.0 if role.startswith("right_") else 1.0
        total = self.angles.setdefault(role, np.zeros((len(self.time), 3)))
        total[:, 0] += flexion
        total[:, 1] += mirror * np.asarray(abduction)
        total[:, 2] += mirror * np.asarray(twist)


# Height by which a foot may be lifted and still counts as standing [m].
_SOFT = 0.004

# Angle between the arms and the vertical in an A-pose, to which the motions' angles are added.
_ARMS_AWAY = 45.0

_FEET = ("left_foot", "right_foot")

Maker = Callable[[Track, np.random.Generator], None]


def make_motion(subject: Subject, name: str, frames: int, fps: float, seed: int) -> Poses:
    """A motion that begins at rest; angles are kept within the limits of the joints.

    Args:
        subject: who moves; needs hips, legs and feet by one of the usual names.
        name: one of ``MOTIONS``.
        frames: F.
        fps: frames a second.
        seed: of the motion's parameters: speeds, amplitudes, side.

    Returns:
        F poses; frame 0 is the pose at rest, with the feet on the floor at y = 0.

    Raises:
        InputError: unknown motion, no frames, or a skeleton without the joints.
    """
    if name not in MOTIONS:
        raise InputError("Unknown motion", where="motion", expected=", ".join(MOTIONS), got=name)
    if frames < 1 or not fps > 0:
        raise InputError(
            "Motion has no frames", where="motion", expected="frames >= 1, fps > 0", got=f"{frames}, {fps:g}"
        )
    track = Track(np.arange(frames) / fps)
    MOTIONS[name](track, np.random.default_rng(seed))
    return _fitted(subject, track, fps)


def walk(track: Track, rng: np.random.Generator) -> None:
    """Walking on the spot, as a camera sees it that moves along."""
    period = rng.uniform(1.0, 1.25)
    size = rng.uniform(0.85, 1.05)
    phase = track.time / period + 0.25 + rng.integers(2) * 0.5
    _gait(track, phase, size)
    track.stands = False
    track.sway += 0.02 * size * np.cos(2 * np.pi * (phase - 0.3))


def turn(track: Track, rng: np.random.Generator) -> None:
    """Small steps on the spot while the body turns to one side and back."""
    period = rng.uniform(1.0, 1.2)
    _gait(track, track.time / period + 0.25, rng.uniform(0.3, 0.4))
    track.stands = False
    side, through = rng.choice((-1.0, 1.0)), rng.uniform(4.5, 6.0)
    track.turn += (
        side * np.deg2rad(rng.uniform(80, 120)) * 0.5 * (1 - np.cos(2 * np.pi * track.time / through))
    )


def squat(track: Track, rng: np.random.Generator) -> None:
    """Down and up again, feet on the floor, arms held out in front."""
    period, depth = rng.uniform(2.4, 3.2), rng.uniform(0.8, 1.0)
    down = depth * 0.5 * (1 - np.cos(2 * np.pi * track.time / period))
    for side, _ in SIDES:
        track.add(f"{side}_upper_leg", -72 * down, 8 * down, 10 * down)
        track.add(f"{side}_lower_leg", 92 * down)
        track.add(f"{side}_foot", -20 * down, -8 * down, -8 * down)
        track.add(f"{side}_upper_arm", -55 * down, -22)
    track.add("spine", 12 * down)
    track.add("chest", 8 * down)
    track.add("hips", 12 * down)
    for side, _ in SIDES:
        # The hips tilt forward, and the legs with them: taken back there, so that the feet stay flat.
        track.add(f"{side}_upper_leg", -12 * down)


def kick(track: Track, rng: np.random.Generator) -> None:
    """One leg after the other forward and up."""
    period, height = rng.uniform(1.8, 2.4), rng.uniform(0.8, 1.0)
    first = rng.integers(2)
    wave = np.sin(np.pi * track.time / period) ** 2
    which = (np.floor(track.time / period).astype(int) + first) % 2
    # Weight moves over before the other foot leaves the floor.
    left_lifts = _smooth_between(np.where(which == 0, 1.0, 0.0), track.time, 0.15)
    track.support = 1.0 - left_lifts
    for number, (side, _) in enumerate(SIDES):
        up = np.where(which == number, wave, 0.0) * height
        bent = np.where(which == number, np.sin(2 * np.pi * track.time / period) ** 2, 0.0) * height
        track.add(f"{side}_upper_leg", -58 * up, 5)
        track.add(f"{side}_lower_leg", 38 * bent)
        track.add(f"{side}_foot", 15 * up, -5)
        track.add(f"{'right' if side == 'left' else 'left'}_upper_arm", -25 * up)
        track.add(f"{side}_upper_arm", 15 * up, -18)
    track.add("spine", -4 * wave)


def twirl(track: Track, rng: np.random.Generator) -> None:
    """Spinning about the vertical, one way and the other, arms held away."""
    side, fastest = rng.choice((-1.0, 1.0)), 2 * np.pi * rng.uniform(0.6, 0.8)
    period = rng.uniform(3.2, 4.0)
    rate = side * fastest * np.sin(2 * np.pi * track.time / period)
    # Each half of the period spins one way; between them the body stands still.
    rate *= np.abs(np.sin(2 * np.pi * track.time / period))
    interval = float(track.time[1] - track.time[0]) if len(track.time) > 1 else 0.0
    track.turn += np.concatenate(([0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1])) * interval))
    lead = np.rad2deg(rate) / 360
    track.add("chest", 0, 0, 8 * lead)
    track.add("head", 0, 0, 10 * lead)
    for arm, _ in SIDES:
        track.add(f"{arm}_upper_arm", 0, 20 * np.abs(lead))
        track.add(f"{arm}_upper_leg", -4, 1)
        track.add(f"{arm}_lower_leg", 8)
        track.add(f"{arm}_foot", -4, -1)


def arm_swing(track: Track, rng: np.random.Generator) -> None:
    """Both arms to and fro against each other while the trunk turns with them."""
    period, size = rng.uniform(1.4, 2.0), rng.uniform(0.8, 1.1)
    wave = np.sin(2 * np.pi * track.time / period + np.pi * rng.integers(2))
    for side, sign in SIDES:
        track.add(f"{side}_upper_arm", -40 * size * sign * wave, -12)
        track.add(f"{side}_upper_leg", -4 - 2 * sign * wave)
        track.add(f"{side}_lower_leg", 8 + 4 * sign * wave)
        track.add(f"{side}_foot", -4 - 2 * sign * wave)
    # The shoulder of the arm in front comes forward.
    track.add("spine", 2, 0, -8 * size * wave)
    track.add("chest", 0, 0, -8 * size * wave)


MOTIONS: Mapping[str, Maker] = {
    "walk": walk,
    "turn": turn,
    "squat": squat,
    "kick": kick,
    "twirl": twirl,
    "arm_swing": arm_swing,
}
"""Motions by name."""


def _gait(track: Track, phase: Floats, size: float) -> None:
    """Legs, arms and trunk of a stride; ``phase`` is that of the left leg, in strides."""
    for side, sign in SIDES:
        own = phase if sign > 0 else phase + 0.5
        track.add(f"{side}_upper_leg", -size * _periodic(_HIP, own), 1.5)
        track.add(f"{side}_lower_leg", size * _periodic(_KNEE, own))
        track.add(f"{side}_foot", size * _periodic(_ANKLE, own), -1.5)
        # An arm goes with the other side's leg.
        track.add(f"{side}_upper_arm", 18 * size * np.cos(2 * np.pi * own), -18)
    swing = np.cos(2 * np.pi * phase)
    track.add("hips", 0, 2 * size * np.sin(2 * np.pi * phase), -3 * size * swing)
    track.add("spine", 0, -2 * size * np.sin(2 * np.pi * phase), 3 * size * swing)
    track.add("chest", 0, 0, 3 * size * swing)
    # The left foot bears the weight from its strike until the right one has taken over.
    stance = ((phase % 1.0) < 0.5).astype(float)
    track.support = _smooth_between(stance, track.time, 0.05)


def _periodic(points: tuple[tuple[float, float], ...], phase: Floats) -> Floats:
    x, y = np.array(points, dtype=float).T
    return np.asarray(CubicSpline(x, y, bc_type="periodic")(phase % 1.0), dtype=np.float64)


def _smooth_between(values: Floats, time: Floats, width: float) -> Floats:
    """Steps made smooth over a time, in seconds."""
    if len(time) < 2:
        return values
    smooth: Floats = gaussian_filter1d(values, width / float(time[1] - time[0]), mode="nearest")
    return smooth


def _fitted(subject: Subject, track: Track, fps: float) -> Poses:
    roles = humanoid_joints(subject.joint_names)
    needed = {role for role in track.angles if role.endswith(("_leg", "_foot"))} | {"hips", *_FEET}
    missing = sorted(needed - set(roles))
    if missing:
        raise InputError(
            "Skeleton lacks joints that the motion moves",
            where="subject.joint_names",
            expected=f"{', '.join(sorted(needed))}, by one of the usual names",
            got=f"none for {', '.join(missing)}",
        )
    _lower_arms(subject, track, roles)
    grows = _growth(track.time)
    angles = torch.zeros(len(track.time), len(subject.joint_names), 3, dtype=torch.float64)
    for role, degrees in track.angles.items():
        if role in roles:
            angles[:, roles[role]] = torch.from_numpy(np.deg2rad(degrees) * grows[:, None])
    world = rotation_of_angles(angles)
    turn = torch.from_numpy(track.turn * grows)
    about_y = torch.stack((torch.zeros_like(turn), turn, torch.zeros_like(turn)), -1)
    world[:, roles["hips"]] = roma.rotvec_to_rotmat(about_y) @ world[:, roles["hips"]]
    poses = from_world_axes(subject, world, torch.zeros(len(track.time), 3, dtype=torch.float64))
    poses = within_limits(subject, poses)
    return Poses(poses.rotations, _on_the_floor(subject, poses, track, grows, roles, fps))


def _lower_arms(subject: Subject, track: Track, roles: Mapping[str, int]) -> None:
    """Take the arms of a subject that rests in a T-pose to where those of an A-pose are."""
    for side, sign in SIDES:
        arm, elbow = (roles.get(f"{side}_{limb}_arm") for limb in ("upper", "lower"))
        if arm is not None and elbow is not None and f"{side}_upper_arm" in track.angles:
            x, y, _ = (subject.rest_joints[elbow, :3, 3] - subject.rest_joints[arm, :3, 3]).tolist()
            away = float(np.degrees(np.arctan2(sign * x, -y)))
            track.add(f"{side}_upper_arm", 0, min(0.0, _ARMS_AWAY - away))


def _growth(time: Floats) -> Floats:
    """From 0 at the first frame to 1, with speed and acceleration 0 at both ends."""
    x = np.clip(time / SETTLE, 0.0, 1.0)
    return np.asarray(x**3 * (10 - 15 * x + 6 * x * x), dtype=np.float64)


def _on_the_floor(
    subject: Subject, poses: Poses, track: Track, grows: Floats, roles: Mapping[str, int], fps: float
) -> Tensor:
    """Translation of the root, (F, 3), that keeps the foot on the floor which bears the weight."""
    transforms = joint_transforms(subject, poses)
    share = {"left": track.support, "right": 1.0 - track.support}
    move = np.zeros((len(poses), 3))
    heights = []
    for side, _ in SIDES:
        foot = roles[f"{side}_foot"]
        sole = _vertices_below(subject, foot)
        posed = linear_blend(
            subject.rest_vertices[sole],
            subject.skinning_indices[sole],
            subject.skinning_weights[sole],
            transforms,
        )
        heights.append(posed[..., 1].min(1).values.numpy() - float(subject.rest_vertices[sole, 1].min()))
        if track.stands:
            rest = subject.rest_joints[foot, :3, 3]
            shift = (transforms[:, foot, :3, :3] @ rest + transforms[:, foot, :3, 3] - rest).numpy()
            move[:, [0, 2]] -= share[side][:, None] * shift[:, [0, 2]]
    # The lower foot is on the floor; feet, heels and toes take turns, which would jerk the hips.
    move[:, 1] = _SOFT * np.log(np.exp(-np.stack(heights) / _SOFT).mean(0))
    move = gaussian_filter1d(move, 0.04 * fps, axis=0, mode="nearest")
    move += (grows[:, None] - 1) * move[0]
    sway = track.sway * grows
    move[:, 0] += np.cos(track.turn) * sway
    move[:, 2] -= np.sin(track.turn) * sway
    return torch.from_numpy(move)


def _vertices_below(subject: Subject, joint: int) -> Tensor:
    """Vertices whose strongest joint is this one or comes after it."""
    below = torch.zeros(len(subject.joint_names), dtype=torch.bool)
    below[joint] = True
    for child in range(joint + 1, len(below)):
        below[child] = below[int(subject.parents[child])]
    strongest = subject.skinning_indices.gather(1, subject.skinning_weights.argmax(1, keepdim=True))[:, 0]
    found = below[strongest].nonzero().ravel()
    if not len(found):
        raise InputError(
            "Subject has no foot to stand on",
            where="subject.skinning_weights",
            expected=f"vertices that {subject.joint_names[joint]} moves",
            got="none",
        )
    return found
