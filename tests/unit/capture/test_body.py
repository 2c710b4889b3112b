"""Subject, kinematics and skinning against what can be worked out by hand."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import roma
import torch
from torch import Tensor

from toile.capture.body.bake import sparse_landmarks
from toile.capture.body.limits import beyond_limits, joint_angles, within_limits
from toile.capture.body.poses import Poses, from_world_axes, posed_joints, rest_poses
from toile.capture.body.skinning import skin
from toile.capture.body.subject import Subject, load_subject
from toile.errors import InputError


def about(axis: str, degrees: float) -> Tensor:
    return roma.euler_to_rotmat(axis, torch.tensor([math.radians(degrees)], dtype=torch.float64))


def arm(radial: int = 12, rings: int = 21, blended: bool = True) -> Subject:
    """A tube of radius 0.1 along x from 0 to 2, two bones that meet at x = 1."""
    angle = torch.arange(radial, dtype=torch.float64) * 2 * math.pi / radial
    x = torch.linspace(0, 2, rings, dtype=torch.float64)
    vertices = torch.stack(
        (
            x[:, None].expand(-1, radial),
            0.1 * angle.cos().expand(rings, -1),
            0.1 * angle.sin().expand(rings, -1),
        ),
        -1,
    ).reshape(-1, 3)
    a = torch.arange(rings * radial).reshape(rings, radial)
    b = a.roll(-1, 1)
    faces = torch.cat((torch.stack((a[:-1], b[:-1], b[1:]), -1), torch.stack((a[:-1], b[1:], a[1:]), -1)))
    second = vertices[:, 0].clamp(0, 2) / 2 if blended else (vertices[:, 0] > 1).double()
    weights = torch.zeros(len(vertices), 9, dtype=torch.float64)
    weights[:, 0], weights[:, 1] = 1 - second, second
    indices = torch.zeros(len(vertices), 9, dtype=torch.int64)
    indices[:, 1] = 1
    joints = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    joints[1, 0, 3] = 1.0
    joints[1, :3, :3] = about("Z", 40)  # a frame of its own at rest
    return Subject(
        vertices,
        faces.reshape(-1, 3),
        ("upper", "lower"),
        torch.tensor([-1, 0]),
        joints,
        indices,
        weights,
        (),
        torch.empty(0, 1, dtype=torch.int64),
        torch.empty(0, 1, dtype=torch.float64),
    )


def turned(subject: Subject, *world: Tensor) -> Poses:
    return from_world_axes(subject, torch.stack(world)[None], torch.zeros(1, 3, dtype=torch.float64))


@pytest.mark.parametrize("method", ["linear", "dual_quaternion"])
def test_elbow_by_hand(method: str) -> None:
    """The second bone turns by 90° about the joint at (1, 0, 0): (2, y, z) goes to (1 − y, 1, z)."""
    subject = arm(blended=False)
    moved = skin(subject, turned(subject, torch.eye(3, dtype=torch.float64), about("Z", 90)), method)[0]
    x, y, z = subject.rest_vertices.unbind(1)
    expected = torch.where((x > 1)[:, None], torch.stack((1 - y, x - 1, z), 1), subject.rest_vertices)
    assert float((moved - expected).abs().max()) < 1e-14


def test_half_and_half_by_hand() -> None:
    """At x = 1.5 the lower bone has weight 3/4: the mean of both images, and the
    rotation whose half angle has the tangent 3/4 sin 45° / (1/4 + 3/4 cos 45°)."""
    subject = arm()
    poses = turned(subject, torch.eye(3, dtype=torch.float64), about("Z", 90))
    at = int((subject.rest_vertices - torch.tensor([1.5, 0.0, 0.1]).double()).norm(dim=1).argmin())
    point = subject.rest_vertices[at]
    second = torch.stack((1 - point[1], point[0] - 1, point[2]))
    assert skin(subject, poses, "linear")[0, at].allclose(0.25 * point + 0.75 * second, atol=1e-14)
    half = math.atan2(0.75 * math.sin(math.pi / 4), 0.25 + 0.75 * math.cos(math.pi / 4))
    # Both bones keep the joint where it is, so the blended motion is a rotation about it.
    joint = torch.tensor([1.0, 0, 0], dtype=torch.float64)
    expected = joint + about("Z", math.degrees(2 * half)) @ (point - joint)
    assert skin(subject, poses, "dual_quaternion")[0, at].allclose(expected, atol=1e-14)


@pytest.mark.parametrize("method", ["linear", "dual_quaternion"])
def test_a_rigid_motion_of_the_root_moves_everything_rigidly(method: str) -> None:
    subject = arm()
    bent = torch.stack((about("Y", 20), about("X", 70) @ about("Z", 30)))
    first = from_world_axes(subject, bent[None], torch.zeros(1, 3, dtype=torch.float64))
    extra = about("Z", 200) @ about("X", -75)
    shift = torch.tensor([0.3, -0.2, 1.7], dtype=torch.float64)
    root = subject.rest_joints[0, :3, 3]
    second = from_world_axes(
        subject, torch.stack((extra @ bent[0], bent[1]))[None], (shift + extra @ root - root)[None]
    )
    a, b = skin(subject, first, method)[0], skin(subject, second, method)[0]
    assert float((b - (a @ extra.T + shift)).abs().max()) < 1e-13


def test_twisted_tube_keeps_its_volume_under_dual_quaternions() -> None:
    """Turned by 180° about its axis, linear blending pinches the middle, dual quaternions do not."""
    subject = arm()
    poses = turned(subject, torch.eye(3, dtype=torch.float64), about("X", 179.9))
    middle = (subject.rest_vertices[:, 0] - 1).abs() < 1e-9
    radius = {
        method: float(skin(subject, poses, method)[0, middle, 1:].norm(dim=1).mean())
        for method in ("linear", "dual_quaternion")
    }
    assert radius["linear"] < 0.001
    assert radius["dual_quaternion"] == pytest.approx(0.1, rel=1e-12)


def test_quaternions_of_opposite_sign_are_blended_the_short_way() -> None:
    """Beyond 180° a quaternion changes sign: the blend of 170° and 190° is 180° all the same."""
    subject = arm()
    poses = turned(subject, about("X", 170), about("X", 20))
    at = (subject.rest_vertices[:, 0] - 1).abs() < 1e-9
    expected = subject.rest_vertices[at] @ about("X", 180).T
    assert skin(subject, poses)[0, at].allclose(expected, atol=1e-12)


def test_many_frames_equal_single_ones() -> None:
    subject = arm()
    poses = [turned(subject, about("Y", angle), about("X", 3 * angle)) for angle in (0, 30, 65, 110)]
    together = Poses(torch.cat([p.rotations for p in poses]), torch.cat([p.root_translation for p in poses]))
    for method in ("linear", "dual_quaternion"):
        singles = torch.cat([skin(subject, pose, method) for pose in poses])
        assert skin(subject, together, method).allclose(singles, atol=1e-15)


def test_default_subject() -> None:
    subject = load_subject()
    assert subject.rest_vertices.shape == (13718, 3)
    assert float(subject.rest_vertices[:, 1].min()) == pytest.approx(0.0, abs=1e-6)
    assert 1.6 < subject.height < 1.9
    assert set(subject.landmark_names) >= {"nose", "left_hip", "right_wrist", "left_ankle"}
    left = subject.landmarks(subject.rest_vertices)[subject.landmark_names.index("left_wrist")]
    assert float(left[0]) > 0.2  # left is +x
    nose = subject.landmarks(subject.rest_vertices)[subject.landmark_names.index("nose")]
    assert float(nose[2]) > float(subject.rest_vertices[subject.parts["head"], 2].mean())  # it faces +z
    arms = subject.rest_vertices[subject.parts["arms"]]
    assert float(arms[:, 0].abs().min()) > 0.1
    assert float((skin(subject, rest_poses(subject))[0] - subject.rest_vertices).abs().max()) < 1e-12
    path = Path(__file__).parents[3] / "src/toile/capture/body/subjects/default.npz"
    assert path.stat().st_size < 3e6
    assert "CC0" in path.with_name("default.LICENSE.txt").read_text(encoding="utf-8")


def test_normals_of_the_default_subject_point_outward() -> None:
    subject = load_subject()
    corners = subject.rest_vertices[subject.faces]
    volume = (corners[:, 0] * torch.linalg.cross(corners[:, 1], corners[:, 2])).sum() / 6
    assert 0.03 < float(volume) < 0.12


def test_subject_round_trip(tmp_path: Path) -> None:
    subject = load_subject()
    first, second = subject.save(tmp_path / "a.npz"), subject.save(tmp_path / "b.npz")
    again = Subject.load(first)
    assert first.read_bytes() == second.read_bytes()
    assert again.joint_names == subject.joint_names
    assert float((again.rest_vertices - subject.rest_vertices).abs().max()) < 1e-7
    assert torch.equal(again.faces, subject.faces)
    assert all(torch.equal(again.parts[name], mask) for name, mask in subject.parts.items())
    assert torch.equal(again.joint_limits, subject.joint_limits)


def test_limits_bring_a_knee_back() -> None:
    subject = load_subject()
    knee = subject.joint_names.index("lowerleg01.L")
    world = torch.eye(3, dtype=torch.float64).repeat(2, len(subject.joint_names), 1, 1)
    world[0, knee] = about("X", -30)  # knees do not bend forward
    world[1, knee] = about("X", 60)
    poses = from_world_axes(subject, world, torch.zeros(2, 3, dtype=torch.float64))
    assert float(beyond_limits(subject, poses)[0].max()) == pytest.approx(math.radians(30))
    limited = within_limits(subject, poses)
    assert float(beyond_limits(subject, limited).max()) < 1e-12
    assert float(joint_angles(subject, limited)[1, knee, 0]) == pytest.approx(math.radians(60))
    assert limited.rotations[1].allclose(poses.rotations[1], atol=1e-14)


def test_landmarks_from_few_vertices_are_those_from_many() -> None:
    """Under linear blending in every pose, because the sums for each joint are the same."""
    subject = load_subject()
    generator = torch.Generator().manual_seed(0)
    regressor = torch.zeros(1, len(subject.rest_vertices), dtype=torch.float64)
    near = (subject.rest_vertices - torch.tensor([0.14, 0.5, 0.05])).norm(dim=1).topk(500, largest=False)
    regressor[0, near.indices] = torch.rand(500, generator=generator, dtype=torch.float64)
    regressor /= regressor.sum()
    indices, weights = sparse_landmarks(
        regressor,
        subject.rest_vertices,
        subject.skinning_indices,
        subject.skinning_weights,
        len(subject.joint_names),
    )
    assert indices.shape[1] < 60
    assert bool((weights >= 0).all())
    turns = 0.8 * torch.randn(3, len(subject.joint_names), 3, generator=generator, dtype=torch.float64)
    poses = Poses(roma.rotvec_to_rotmat(turns), torch.zeros(3, 3, dtype=torch.float64))
    posed = skin(subject, poses, "linear")
    few = (posed[:, indices] * weights[..., None]).sum(2)
    assert few.allclose(regressor @ posed, atol=1e-8)


def _broken(**changes: object) -> dict[str, object]:
    subject = arm()
    return {**{name: getattr(subject, name) for name in subject.__dataclass_fields__}, **changes}


@pytest.mark.parametrize(
    ("name", "change", "says"),
    [
        ("skinning_weights", lambda w: w * (torch.arange(len(w)) != 7)[:, None], "that no joint moves"),
        ("skinning_weights", lambda w: 2 * w, "no weights"),
        ("skinning_indices", lambda i: i + 1, "out of range"),
        ("parents", lambda p: torch.tensor([1, -1]), "order of a tree"),
        ("rest_vertices", lambda v: v * float("nan"), "not finite"),
        ("rest_joints", lambda j: j[:1], "wrong shape"),
    ],
)
def test_bad_subjects_are_named(name: str, change, says: str) -> None:
    with pytest.raises(InputError, match=says) as caught:
        Subject(**_broken(**{name: change(getattr(arm(), name))}))  # type: ignore[arg-type]
    assert name in caught.value.where


def test_bad_files_and_names_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="No such subject"):
        load_subject("nobody")
    with pytest.raises(InputError, match="missing"):
        load_subject(tmp_path / "nobody.npz")
    (tmp_path / "text.npz").write_text("no archive")
    with pytest.raises(InputError, match="cannot be read"):
        load_subject(tmp_path / "text.npz")
    np.savez(tmp_path / "other.npz", rest_vertices=np.zeros((3, 3)))
    with pytest.raises(InputError, match="incomplete") as caught:
        load_subject(tmp_path / "other.npz")
    assert "skinning_weights" in caught.value.got
    with pytest.raises(InputError, match="skinning method"):
        skin(arm(), rest_poses(arm()), "spherical")
    with pytest.raises(InputError, match="another skeleton"):
        posed_joints(load_subject(), rest_poses(arm()))
    with pytest.raises(InputError, match="part"):
        arm().faces_without("wings")
