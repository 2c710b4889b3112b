"""Motions: limits, feet, seeds, files of other programs."""

from __future__ import annotations

import json
import math
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import roma
import torch
from torch import Tensor

from toile.capture.body.gltf import subject_from_gltf
from toile.capture.body.limits import beyond_limits, joint_angles
from toile.capture.body.poses import Poses, from_world_axes, posed_joints, rest_poses
from toile.capture.body.skinning import skin
from toile.capture.body.subject import Subject, load_subject
from toile.capture.garments.quality import crossing_edges
from toile.capture.motion.bvh import read_bvh
from toile.capture.motion.files import load_motion
from toile.capture.motion.procedural import MOTIONS, make_motion
from toile.capture.motion.skeleton_motion import resampled
from toile.errors import InputError

FPS = 30.0


@pytest.fixture(scope="module")
def subject() -> Subject:
    return load_subject()


def joint(subject: Subject, poses: Poses, name: str) -> Tensor:
    return posed_joints(subject, poses)[:, subject.joint_names.index(name), :3, 3]


@pytest.mark.parametrize("name", MOTIONS)
def test_motions_begin_at_rest_within_limits_with_a_foot_on_the_floor(name: str, subject: Subject) -> None:
    for seed in (0, 1):
        poses = make_motion(subject, name, 60, FPS, seed)
        assert len(poses) == 60
        assert float((poses.rotations[0] - torch.eye(3).double()).abs().max()) < 1e-12
        assert float(poses.root_translation[0].abs().max()) < 1e-12
        # To rounding, which differs between processors.
        assert float(beyond_limits(subject, poses).max()) < 1e-12
        some = Poses(poses.rotations[::6], poses.root_translation[::6])
        lowest = skin(subject, some, "linear")[..., 1].amin(1)
        assert float(lowest.min()) > -0.012
        assert float(lowest.max()) < 0.012
    first, again = (make_motion(subject, name, 60, FPS, 1) for _ in range(2))
    assert torch.equal(first.rotations, again.rotations)
    assert not first.rotations.allclose(make_motion(subject, name, 60, FPS, 2).rotations)


@pytest.mark.parametrize("name", ["walk", "twirl", "squat"])
def test_legs_do_not_pass_through_each_other(name: str, subject: Subject) -> None:
    left, right = (subject.parts[f"{side}_leg"][subject.faces].all(1) for side in ("left", "right"))
    poses = make_motion(subject, name, 90, FPS, 0)
    for vertices in skin(subject, Poses(poses.rotations[10::13], poses.root_translation[10::13])).numpy():
        one, other = subject.faces[left].numpy(), subject.faces[right].numpy()
        assert crossing_edges(vertices, one, vertices, other) == 0
        assert crossing_edges(vertices, other, vertices, one) == 0


def test_each_motion_does_what_it_is_called(subject: Subject) -> None:
    made = {name: make_motion(subject, name, 120, FPS, 0) for name in MOTIONS}
    hips = joint(subject, made["squat"], "root")[:, 1]
    assert float(hips[0] - hips.min()) > 0.2
    feet = joint(subject, made["squat"], "foot.L")
    assert float((feet - feet[0]).norm(dim=1).max()) < 0.03
    ankles = [joint(subject, made["walk"], f"foot.{side}") for side in "LR"]
    apart = (ankles[0] - ankles[1])[15:, 2]
    assert float(apart.max()) > 0.3
    assert float(apart.min()) < -0.3
    kicks = torch.stack([joint(subject, made["kick"], f"foot.{side}")[:, 1] for side in "LR"])
    assert float(kicks.amax(1).min()) > 0.3
    turned = roma.rotmat_to_rotvec(made["turn"].rotations[:, 0]).norm(dim=1)
    assert float(turned.max()) > math.radians(70)
    root = made["twirl"].rotations[:, 0]
    spin = roma.rotmat_to_rotvec(root[:-1].mT @ root[1:]).norm(dim=1) * FPS
    assert float(spin.max()) > 3.0  # rad/s
    wrists = joint(subject, made["arm_swing"], "wrist.L")
    assert float(wrists[:, 2].max() - wrists[:, 2].min()) > 0.4


def test_bad_requests_are_named(subject: Subject, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="Unknown motion") as caught:
        make_motion(subject, "fly", 10, FPS, 0)
    assert "walk" in caught.value.expected
    with pytest.raises(InputError, match="no frames"):
        make_motion(subject, "walk", 0, FPS, 0)
    with pytest.raises(InputError, match="Unknown format"):
        load_motion(subject, tmp_path / "walk.fbx", FPS)
    with pytest.raises(InputError, match="missing"):
        load_motion(subject, tmp_path / "walk.bvh", FPS)


def bvh(path: Path, rows: list[list[float]], interval: float = 0.05) -> Path:
    """A T-pose with hips at 90 cm, in centimetres; hips, left hip, knee and shoulder turn."""
    text = """HIERARCHY
ROOT Hips
{
  OFFSET 0 90 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT LeftUpLeg
  {
    OFFSET 10 0 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    JOINT LeftLeg
    {
      OFFSET 0 -42 0
      CHANNELS 3 Zrotation Xrotation Yrotation
      JOINT LeftFoot
      {
        OFFSET 0 -42 0
        CHANNELS 0
        End Site
        {
          OFFSET 0 -6 10
        }
      }
    }
  }
  JOINT RightUpLeg
  {
    OFFSET -10 0 0
    CHANNELS 0
    JOINT RightLeg
    {
      OFFSET 0 -42 0
      CHANNELS 0
      JOINT RightFoot
      {
        OFFSET 0 -42 0
        CHANNELS 0
      }
    }
  }
  JOINT LeftArm
  {
    OFFSET 18 50 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    JOINT LeftForeArm
    {
      OFFSET 28 0 0
      CHANNELS 0
      JOINT LeftHand
      {
        OFFSET 25 0 0
        CHANNELS 0
      }
    }
  }
}
MOTION
"""
    lines = [" ".join(f"{x:g}" for x in row) for row in rows]
    path.write_text(f"{text}Frames: {len(rows)}\nFrame Time: {interval}\n" + "\n".join(lines) + "\n")
    return path


def row(
    root: tuple[float, ...] = (0, 90, 0), hip: float = 0, knee: float = 0, arm: float = 0, yaw: float = 0
) -> list[float]:
    return [*root, 0, 0, yaw, 0, hip, 0, 0, knee, 0, arm, 0, 0]


def test_bvh_by_hand(tmp_path: Path) -> None:
    """Hip 90° forward, knee 90° back: the knee is 42 cm in front of the hip, the foot 42 cm below it."""
    motion = read_bvh(bvh(tmp_path / "a.bvh", [row(), row((5, 90, 1), hip=-90, knee=90, yaw=90)]))
    assert motion.fps == pytest.approx(20.0)
    foot = motion.joint_names.index("LeftFoot")
    assert motion.positions[0, foot].tolist() == pytest.approx([10, 6, 0])
    # Turned by 90° to the left, forward is +x and left is −z.
    assert motion.positions[1, foot].tolist() == pytest.approx([5 + 42, 90 - 42, 1 - 10])


def test_bvh_on_the_subject(subject: Subject, tmp_path: Path) -> None:
    """Limbs point where those of the file point, whatever the pose at rest; centimetres become metres."""
    file = bvh(tmp_path / "a.bvh", [row(), row(hip=-60, knee=45, arm=-50), row((30, 90, 0), yaw=90)])
    poses = load_motion(subject, file, 20.0)
    assert len(poses) == 10 + 3
    assert float((poses.rotations[0] - torch.eye(3).double()).abs().max()) < 1e-12
    points = posed_joints(subject, poses)[10:, :, :3, 3]

    def direction(frame: int, start: str, end: str) -> list[float]:
        a, b = (points[frame, subject.joint_names.index(name)] for name in (start, end))
        return torch.nn.functional.normalize(b - a, dim=0).tolist()

    assert direction(0, "upperarm01.L", "lowerarm01.L") == pytest.approx([1, 0, 0], abs=1e-9)
    assert direction(0, "upperleg01.L", "lowerleg01.L") == pytest.approx([0, -1, 0], abs=1e-9)
    s, c = math.sin(math.radians(60)), math.cos(math.radians(60))
    assert direction(1, "upperleg01.L", "lowerleg01.L") == pytest.approx([0, -c, s], abs=1e-9)
    s, c = math.sin(math.radians(15)), math.cos(math.radians(15))
    assert direction(1, "lowerleg01.L", "foot.L") == pytest.approx([0, -c, s], abs=1e-9)
    s, c = math.sin(math.radians(50)), math.cos(math.radians(50))
    assert direction(1, "upperarm01.L", "lowerarm01.L") == pytest.approx([c, -s, 0], abs=1e-9)
    assert direction(2, "upperarm01.L", "lowerarm01.L") == pytest.approx([0, 0, -1], abs=1e-9)
    # 30 cm, scaled by the length of the legs from hip to ankle.
    legs = np.linalg.norm(np.diff(subject.rest_joints[[2, 6], :3, 3].numpy(), axis=0))
    assert float(points[2, 0, 0] - points[0, 0, 0]) == pytest.approx(0.3 * legs / 0.84, rel=0.02)
    assert float(skin(subject, poses)[10:, :, 1].min()) == pytest.approx(0.0, abs=0.005)


def test_resampling_keeps_the_motion(subject: Subject) -> None:
    """A turn of constant speed stays one at any rate; rotations take the shorter way."""
    angles = torch.tensor([0.0, 2.5, 5.0, 7.5], dtype=torch.float64)
    rotations = rest_poses(subject, 4).rotations.clone()
    rotations[:, 0] = roma.euler_to_rotmat("Y", angles[:, None])
    poses = resampled(Poses(rotations, torch.stack((angles, 0 * angles, 0 * angles), 1)), 10.0, 40.0)
    assert len(poses) == 13
    expected = torch.linspace(0, 7.5, 13, dtype=torch.float64)
    assert poses.root_translation[:, 0].allclose(expected)
    assert poses.rotations[:, 0].allclose(roma.euler_to_rotmat("Y", expected[:, None]), atol=1e-12)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("Frames: 2", "Frames: 3", "incomplete"),
        ("MOTION", "", "line"),
        ("OFFSET 10 0 0", "OFFSET 10 0", "line 8"),
        ("CHANNELS 3", "CHANNELS 4", "line 9"),
        ("Frame Time: 0.05", "Frame Time: 0", "Frame Time: 0"),
        ("0 90 0 0 0 0", "0 90 0 0 0", "finite numbers"),
        ("0 90 0 0 0 0", "0 90 0 0 0 nan", "finite numbers"),
        ("LeftUpLeg", "Wheel", "left_upper_leg"),
    ],
)
def test_bad_bvh_is_named(subject: Subject, tmp_path: Path, old: str, new: str, says: str) -> None:
    file = bvh(tmp_path / "a.bvh", [row(), row()])
    file.write_text(file.read_text().replace(old, new, 1))
    with pytest.raises(InputError) as caught:
        load_motion(subject, file, FPS)
    assert says in str(caught.value)
    assert "a.bvh" in caught.value.where


class Glb:
    """Puts a binary glTF file together."""

    def __init__(self) -> None:
        self.binary = bytearray()
        self.content: dict[str, Any] = {"asset": {"version": "2.0"}, "bufferViews": [], "accessors": []}

    def add(self, array: np.ndarray, kind: str, code: int) -> int:
        self.binary += b"\0" * (-len(self.binary) % 4)
        view = {"buffer": 0, "byteOffset": len(self.binary), "byteLength": array.nbytes}
        self.content["bufferViews"].append(view)
        self.binary += array.tobytes()
        accessor = {"bufferView": len(self.content["bufferViews"]) - 1, "componentType": code}
        self.content["accessors"].append({**accessor, "count": len(array), "type": kind})
        return len(self.content["accessors"]) - 1

    def write(self, path: Path) -> Path:
        self.content["buffers"] = [{"byteLength": len(self.binary)}]
        text = json.dumps(self.content).encode()
        text += b" " * (-len(text) % 4)
        body = bytes(self.binary) + b"\0" * (-len(self.binary) % 4)
        chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
        chunks += struct.pack("<II", len(body), 0x004E4942) + body
        path.write_bytes(struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks)
        return path


def figure(**changes: Any) -> Glb:
    """A stick figure of cubes, one on every joint, in a node scaled by 0.01; its left hip is animated."""
    glb = Glb()
    joints = {
        "Hips": (None, (0, 90, 0)),
        "LeftUpLeg": ("Hips", (10, 0, 0)),
        "LeftLeg": ("LeftUpLeg", (0, -42, 0)),
        "LeftFoot": ("LeftLeg", (0, -42, 0)),
        "RightUpLeg": ("Hips", (-10, 0, 0)),
        "RightLeg": ("RightUpLeg", (0, -42, 0)),
        "RightFoot": ("RightLeg", (0, -42, 0)),
    }
    names = list(joints)
    nodes: list[dict[str, Any]] = [{"name": "Armature", "scale": [0.01] * 3, "children": [1, len(names) + 1]}]
    places = {}
    for name, (parent, offset) in joints.items():
        places[name] = np.array(offset, dtype=float) + (places[parent] if parent else 0)
        children = [k + 1 for k, other in enumerate(names) if joints[other][0] == name]
        nodes.append({"name": f"mixamorig:{name}", "translation": list(offset), "children": children})
    cube = np.array([[x, y, z] for x in (-4, 4) for y in (-4, 4) for z in (-4, 4)], dtype=float)
    sides = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6]]
    sides += [[0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
    points = np.concatenate([cube + places[name] for name in names])
    faces = np.concatenate([np.array(sides) + 8 * k for k in range(len(names))])
    of = np.zeros((len(points), 4), dtype=np.uint8)
    of[:, 0] = np.repeat(np.arange(len(names)), 8)
    weights = np.zeros((len(points), 4), dtype="<f4")
    weights[:, 0] = changes.get("weight", 1.0)
    inverse = np.tile(np.eye(4), (len(names), 1, 1))
    inverse[:, :3, 3] = [-places[name] for name in names]
    attributes = {"POSITION": glb.add(points.astype("<f4"), "VEC3", 5126)}
    if changes.get("weights", True):
        attributes["JOINTS_0"] = glb.add(of, "VEC4", 5121)
        attributes["WEIGHTS_0"] = glb.add(weights, "VEC4", 5126)
    nodes.append({"name": "body", "mesh": 0, **({"skin": 0} if changes.get("skin", True) else {})})
    times = np.array([0.0, 1.0], dtype="<f4")
    half = math.sqrt(0.5)
    turns = np.array([[0, 0, 0, 1], [-half, 0, 0, half]], dtype="<f4")  # 90° forward
    glb.content |= {
        "nodes": nodes,
        "meshes": [
            {
                "primitives": [
                    {
                        "attributes": attributes,
                        "indices": glb.add(faces.astype("<u2").ravel(), "SCALAR", 5123),
                    }
                ]
            }
        ],
        "skins": [
            {
                "joints": list(range(1, len(names) + 1)),
                "inverseBindMatrices": glb.add(
                    inverse.transpose(0, 2, 1).astype("<f4").reshape(-1, 16), "MAT4", 5126
                ),
            }
        ],
        "animations": [
            {
                "channels": [{"sampler": 0, "target": {"node": 2, "path": "rotation"}}],
                "samplers": [
                    {"input": glb.add(times, "SCALAR", 5126), "output": glb.add(turns, "VEC4", 5126)}
                ],
            }
        ],
    }
    return glb


def test_a_skinned_gltf_file_is_a_subject(tmp_path: Path) -> None:
    subject = subject_from_gltf(figure().write(tmp_path / "figure.glb"))
    assert subject.rest_vertices.shape == (56, 3)
    assert subject.height == pytest.approx(0.92, abs=1e-6)  # centimetres by the scale of the node
    assert float(subject.rest_vertices[:, 1].min()) == pytest.approx(0.0, abs=1e-12)
    assert bool(subject.parts["left_leg"][8:32].all())
    assert not bool(subject.parts["left_leg"][:8].any())
    knee = subject.joint_names.index("mixamorig:LeftLeg")
    assert float(subject.joint_limits[knee, 0, 0]) == 0.0
    at = subject.landmarks(subject.rest_vertices)[subject.landmark_names.index("left_knee")]
    assert at.allclose(subject.rest_joints[knee, :3, 3], atol=1e-6)
    again = Subject.load(subject.save(tmp_path / "figure.npz"))
    assert float((again.rest_vertices - subject.rest_vertices).abs().max()) < 1e-7


def test_an_animated_gltf_file_moves_its_own_subject(tmp_path: Path) -> None:
    """The left leg comes forward by 90° in a second: half-way the knee is at 45°."""
    file = figure().write(tmp_path / "figure.glb")
    subject = subject_from_gltf(file)
    poses = load_motion(subject, file, 10.0)
    assert len(poses) == 5 + 11
    points = posed_joints(subject, poses)[5:, :, :3, 3]
    hip, knee = (subject.joint_names.index(f"mixamorig:Left{name}") for name in ("UpLeg", "Leg"))
    for frame, angle in ((0, 0.0), (5, 45.0), (10, 90.0)):
        leg = (points[frame, knee] - points[frame, hip]).tolist()
        s, c = math.sin(math.radians(angle)), math.cos(math.radians(angle))
        assert leg == pytest.approx([0, -0.42 * c, 0.42 * s], abs=1e-6)
    assert math.degrees(float(joint_angles(subject, poses)[10, hip, 0])) == pytest.approx(-45, abs=1e-4)


def test_a_skeleton_without_arms_walks(tmp_path: Path) -> None:
    subject = subject_from_gltf(figure().write(tmp_path / "figure.glb"))
    poses = make_motion(subject, "walk", 40, FPS, 0)
    feet = posed_joints(subject, poses)[:, [subject.joint_names.index("mixamorig:LeftFoot")], 2, 3]
    assert float(feet.max() - feet.min()) > 0.15
    assert float(skin(subject, poses)[..., 1].amin(1).abs().max()) < 0.02


def test_arms_of_a_t_pose_come_down(subject: Subject) -> None:
    """Whatever the pose at rest: within half a second the arm points where that of an A-pose does."""
    shoulder, elbow = (subject.joint_names.index(name) for name in ("upperarm01.L", "lowerarm01.L"))
    world = torch.eye(3, dtype=torch.float64).repeat(1, len(subject.joint_names), 1, 1)
    world[0, shoulder] = roma.euler_to_rotmat("Z", torch.tensor([math.radians(48)], dtype=torch.float64))
    raised = from_world_axes(subject, world, torch.zeros(1, 3, dtype=torch.float64))
    other = replace(
        subject,
        rest_vertices=skin(subject, raised, "linear")[0],
        rest_joints=posed_joints(subject, raised)[0],
    )

    def down(who: Subject) -> float:
        points = posed_joints(who, make_motion(who, "walk", 25, FPS, 0))[-1, :, :3, 3]
        arm = points[elbow] - points[shoulder]
        return math.degrees(math.atan2(float(arm[0]), float(-arm[1])))

    assert down(subject) < 35
    assert down(other) == pytest.approx(down(subject), abs=5)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"weights": False}, "no skinning weights"),
        ({"skin": False}, "no skinned mesh"),
        ({"weight": 0.0}, "no joint moves"),
    ],
)
def test_a_gltf_file_that_is_no_subject_is_named(tmp_path: Path, changes: dict[str, Any], says: str) -> None:
    with pytest.raises(InputError, match=says):
        subject_from_gltf(figure(**changes).write(tmp_path / "figure.glb"))


def test_broken_gltf_files_are_named(tmp_path: Path) -> None:
    file = figure().write(tmp_path / "figure.glb")
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError):
        subject_from_gltf(file)
    (tmp_path / "away.gltf").write_text(
        json.dumps({"asset": {"version": "2.0"}, "buffers": [{"uri": "../secret.bin", "byteLength": 4}]})
    )
    (tmp_path.parent / "secret.bin").write_bytes(b"1234")
    with pytest.raises(InputError, match="Buffer"):
        subject_from_gltf(tmp_path / "away.gltf")
