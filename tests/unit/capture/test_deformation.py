"""Embedded graphs, the deformation f(θ, α, A, T), and the global translation."""

from __future__ import annotations

import math

import pytest
import roma
import torch
from torch import Tensor

from toile.capture.body.limits import AXES, rotation_of_angles
from toile.capture.body.poses import Poses, from_world_axes, joint_transforms, rest_poses
from toile.capture.body.skinning import dual_quaternion_blend, skin
from toile.capture.body.subject import Subject, load_subject
from toile.capture.deformation.deform import Deformation, parameters_of_poses
from toile.capture.deformation.garment_skinning import garment_skinning
from toile.capture.deformation.graph import (
    EmbeddedGraph,
    embedded_deformation,
    embedded_graph,
    fabric_rigidity,
)
from toile.capture.deformation.translation import along_world, global_translation
from toile.capture.garments import Garment, Material, attached_targets, make_skirt
from toile.capture.motion.procedural import make_motion
from toile.errors import InputError
from toile.geometry.camera import Camera, looking_at
from toile.geometry.mesh import grid_faces
from toile.physics.topology import Topology

NODES = 24


@pytest.fixture(scope="module")
def subject() -> Subject:
    return load_subject()


@pytest.fixture(scope="module")
def skirt(subject: Subject) -> Garment:
    return make_skirt(subject, vertices=500)


@pytest.fixture(scope="module")
def graph(skirt: Garment) -> EmbeddedGraph:
    return embedded_graph(skirt.rest_vertices, skirt.faces, NODES)


@pytest.fixture(scope="module")
def deformation(subject: Subject, skirt: Garment, graph: EmbeddedGraph) -> Deformation:
    return Deformation(subject, skirt, graph)


@pytest.fixture
def random() -> torch.Generator:
    return torch.Generator().manual_seed(5)


def normal(*shape: int, random: torch.Generator, scale: float = 1.0) -> Tensor:
    return scale * torch.randn(*shape, dtype=torch.float64, generator=random)


def strip(length: int = 21) -> tuple[Tensor, Tensor]:
    """Three vertices wide, 5 cm a step."""
    u, v = torch.meshgrid(torch.arange(length), torch.arange(3), indexing="ij")
    flat = torch.stack((0.05 * u, 0.05 * v, 0 * u), -1).double().reshape(-1, 3)
    return flat, grid_faces(length, 3)


def camera_at(x: float, y: float, z: float) -> Camera:
    lens = Camera(fx=300, fy=310, cx=120, cy=130, height=256, width=256)
    centre = torch.tensor([x, y, z], dtype=torch.float64)
    return looking_at(lens, centre, torch.tensor([0.0, 0.9, 0.0]), torch.tensor([0.0, 1.0, 0.0]))


# ---- the graph


def test_nodes_cover_the_mesh_and_weights_are_weights(skirt: Garment, graph: EmbeddedGraph) -> None:
    assert len(graph.vertices.unique()) == NODES
    assert graph.weights.min() >= 0
    torch.testing.assert_close(graph.weights.sum(1), torch.ones(len(skirt.rest_vertices)).double())
    apart = torch.cdist(graph.positions, graph.positions) + 9 * torch.eye(NODES)
    covered = torch.cdist(skirt.rest_vertices, graph.positions).amin(1)
    # Farthest points: no vertex is farther from its node than the nodes are from each other (along the mesh,
    # which is a little longer than the straight lines measured here).
    assert covered.max() <= 1.25 * apart.min()
    # A node moves its own vertex most.
    own = graph.indices[graph.vertices].gather(1, graph.weights[graph.vertices].argmax(1, keepdim=True))
    assert own[:, 0].tolist() == list(range(NODES))


def test_the_same_mesh_gives_the_same_graph(skirt: Garment, graph: EmbeddedGraph) -> None:
    again = embedded_graph(skirt.rest_vertices, skirt.faces, NODES)
    for name in ("vertices", "positions", "indices", "weights", "edges", "rigidity"):
        assert torch.equal(getattr(again, name), getattr(graph, name))


def test_distances_run_along_the_mesh(random: torch.Generator) -> None:
    """A strip folded like two trouser legs, 1 cm apart: nodes of one do not move the end of the other."""
    flat, faces = strip()
    folded = flat.clone()
    folded[:, 0] = 0.5 - (flat[:, 0] - 0.5).abs()
    folded[:, 2] = torch.where(flat[:, 0] > 0.5, 0.01, 0.0)
    legs = embedded_graph(folded, faces, 8)
    first = flat[:, 0] <= 0.2
    moving = legs.vertices[legs.indices[first]][legs.weights[first] > 0]
    assert flat[moving, 0].max() <= 0.65
    # The ends are not neighbours in the graph either.
    ends = flat[legs.vertices][legs.edges][..., 0]
    assert (ends[:, 0] - ends[:, 1]).abs().max() < 0.7


def test_pieces_each_get_a_node_or_it_is_said() -> None:
    flat, faces = strip(6)
    two = torch.cat((flat, flat + 5)), torch.cat((faces, faces + len(flat)))
    pieces = embedded_graph(*two, 3)
    nodes = pieces.vertices[pieces.indices] >= len(flat)
    second = torch.arange(2 * len(flat)) >= len(flat)
    assert bool((nodes == second[:, None])[pieces.weights > 0].all())
    assert bool(torch.isfinite(pieces.weights).all())
    with pytest.raises(InputError, match="several pieces"):
        embedded_graph(*two, 1)
    with pytest.raises(InputError, match="does not fit the mesh"):
        embedded_graph(*two, 1000)


def test_rigidity_is_that_of_the_material(skirt: Garment) -> None:
    denim = fabric_rigidity(Material(young=3 * Material().young))
    assert denim == pytest.approx(3)
    upper = skirt.rest_vertices[:, 1] > skirt.rest_vertices[:, 1].mean()
    mixed = embedded_graph(skirt.rest_vertices, skirt.faces, NODES, torch.where(upper, denim, 1.0).double())
    expected = torch.where(upper[mixed.vertices], 3.0, 1.0)[mixed.edges].mean(1).double()
    torch.testing.assert_close(mixed.rigidity, expected)
    assert set(mixed.rigidity.tolist()) == {1.0, 2.0, 3.0}


# ---- embedded deformation


def test_one_node_by_hand() -> None:
    """90° about x takes y to z, around the node, then the translation in the axes at rest."""
    vertices = torch.tensor([[1.0, 2, 3], [1, 3, 3], [2, 2, 3]], dtype=torch.float64)
    one = embedded_graph(vertices, torch.tensor([[0, 1, 2]]), 1)
    A = torch.tensor([[[math.pi / 2, 0, 0]]], dtype=torch.float64)
    T = torch.tensor([[[0.0, 10, 0]]], dtype=torch.float64)
    expected = torch.tensor([[[1.0, 12, 3], [1, 12, 4], [2, 12, 3]]], dtype=torch.float64)
    torch.testing.assert_close(embedded_deformation(one, vertices, A, T), expected)


def test_nodes_that_move_together_move_the_mesh_rigidly(
    skirt: Garment, graph: EmbeddedGraph, random: torch.Generator
) -> None:
    angles, shift = normal(2, 1, 3, random=random), normal(2, 1, 3, random=random)
    R = rotation_of_angles(angles)
    T = graph.positions @ R[:, 0].mT + shift - graph.positions
    moved = embedded_deformation(graph, skirt.rest_vertices, angles.expand(2, NODES, 3), T)
    torch.testing.assert_close(moved, skirt.rest_vertices @ R[:, 0].mT + shift)


def test_leading_dimensions_are_a_batch(
    skirt: Garment, graph: EmbeddedGraph, random: torch.Generator
) -> None:
    A, T = (normal(2, 3, NODES, 3, random=random, scale=0.2) for _ in range(2))
    moved = embedded_deformation(graph, skirt.rest_vertices, A, T)
    torch.testing.assert_close(
        moved[1, 2], embedded_deformation(graph, skirt.rest_vertices, A[1, 2], T[1, 2])
    )
    with pytest.raises(InputError, match="another embedded graph"):
        embedded_deformation(graph, skirt.rest_vertices, A[..., :-1, :], T[..., :-1, :])


def test_whole_turns_of_a_node_change_nothing(deformation: Deformation, random: torch.Generator) -> None:
    theta, alpha = normal(1, 17, 3, random=random, scale=0.2), normal(1, 3, random=random)
    A, T = normal(1, NODES, 3, random=random), normal(1, NODES, 3, random=random, scale=0.05)
    turns = 2 * math.pi * torch.randint(-2, 3, A.shape, generator=random)
    once = deformation(theta, alpha, A, T).garment
    torch.testing.assert_close(deformation(theta, alpha + 2 * math.pi, A + turns, T).garment, once)
    # The other name of the same rotation: (a, b, c) and (a + π, π - b, c + π).
    a, b, c = A.unbind(-1)
    other = torch.stack((a + math.pi, math.pi - b, c + math.pi), -1)
    torch.testing.assert_close(deformation(theta, alpha, other, T).garment, once)


# ---- f


def posed(subject: Subject, deformation: Deformation, random: torch.Generator, frames: int = 2) -> Poses:
    """Random poses of the driven joints, the root anywhere."""
    world = rest_poses(subject, frames).rotations
    world[:, deformation.driven] = rotation_of_angles(
        normal(frames, len(deformation.driven), 3, random=random, scale=0.2)
    )
    world[:, 0] = rotation_of_angles(normal(frames, 3, random=random, scale=0.7))
    return from_world_axes(subject, world, normal(frames, 3, random=random))


def test_without_graph_f_is_skinning_seen_from_a_camera(
    subject: Subject, skirt: Garment, deformation: Deformation, random: torch.Generator
) -> None:
    """Body, landmarks, attachment; and back to the world by the camera's axes and the root's place."""
    poses, camera = posed(subject, deformation, random), camera_at(1.5, 1.2, 2.5)
    p = parameters_of_poses(subject, poses, camera)
    local = deformation(p.angles, p.root, with_body=True)
    assert local.body is not None
    body = skin(subject, poses)
    expected = camera.from_world(body) - camera.from_world(p.translation)[:, None]
    torch.testing.assert_close(local.body, expected)
    world = local.map(lambda points: along_world(camera, points) + p.translation[:, None])
    torch.testing.assert_close(world.body, body)
    torch.testing.assert_close(world.landmarks, subject.landmarks(body))
    torch.testing.assert_close(world.attached, attached_targets(skirt, body, subject.faces))
    # The few vertices that are posed without the whole body give the same.
    few = deformation(p.angles, p.root)
    assert few.body is None
    torch.testing.assert_close(few.landmarks, local.landmarks)
    torch.testing.assert_close(few.attached, local.attached)


def test_pose_zero_is_upright_and_faces_the_camera(subject: Subject, deformation: Deformation) -> None:
    found = deformation(torch.zeros(1, 17, 3).double(), torch.zeros(1, 3).double()).landmarks[0]
    at = dict(zip(subject.landmark_names, found, strict=True))
    assert at["nose"][1] < -0.4  # y down: above the root
    assert at["left_ankle"][1] > 0.4
    assert at["nose"][2] < at["left_ear"][2]  # nearer to the camera
    assert at["left_wrist"][0] > 0 > at["right_wrist"][0]  # its left is on the right of the image


def test_deformation_comes_before_the_pose(
    deformation: Deformation, graph: EmbeddedGraph, random: torch.Generator
) -> None:
    """All nodes 10 cm forward at rest: after the pose this is forward of the person, not of the camera."""
    theta, alpha = torch.zeros(1, 17, 3).double(), torch.tensor([[0.3, -0.2, 2.0]], dtype=torch.float64)
    T = torch.tensor([0.0, 0, 0.1], dtype=torch.float64).expand(1, NODES, 3)
    moved = deformation(theta, alpha, torch.zeros_like(T), T).garment - deformation(theta, alpha).garment
    forward = rotation_of_angles(alpha[0])[:, 2] * torch.tensor([1.0, -1, -1])
    torch.testing.assert_close(moved, (0.1 * forward).expand_as(moved), atol=1e-6, rtol=0)


def test_gradients_of_f(deformation: Deformation, random: torch.Generator) -> None:
    inputs = (
        normal(2, 17, 3, random=random, scale=0.2),
        normal(2, 3, random=random),
        normal(2, NODES, 3, random=random, scale=0.3),
        normal(2, NODES, 3, random=random, scale=0.05),
    )
    for tensor in inputs:
        tensor.requires_grad_()

    def outputs(theta: Tensor, alpha: Tensor, A: Tensor, T: Tensor) -> tuple[Tensor, ...]:
        found = deformation(theta, alpha, A, T)
        return found.garment, found.landmarks, found.attached

    assert torch.autograd.gradcheck(outputs, inputs, fast_mode=True, atol=1e-6)


def test_a_body_with_a_graph(subject: Subject, skirt: Garment, graph: EmbeddedGraph) -> None:
    """All of its nodes moved: landmarks and the held vertices of the garment move along."""
    body_graph = embedded_graph(subject.rest_vertices, subject.faces, 20)
    both = Deformation(subject, skirt, graph, body_graph)
    theta, alpha = torch.zeros(1, 17, 3).double(), torch.zeros(1, 3).double()
    A = torch.zeros(1, 20, 3, dtype=torch.float64)
    T = torch.tensor([0.01, 0, 0], dtype=torch.float64).expand(1, 20, 3)
    before, after = both(theta, alpha), both(theta, alpha, body_A=A, body_T=T, with_body=True)
    shift = torch.tensor([0.01, 0, 0], dtype=torch.float64)
    torch.testing.assert_close(after.landmarks - before.landmarks, shift.expand_as(before.landmarks))
    torch.testing.assert_close(after.attached - before.attached, shift.expand_as(before.attached))
    torch.testing.assert_close(both(theta, alpha, body_A=A, body_T=T).landmarks, after.landmarks)


def test_single_precision(deformation: Deformation, random: torch.Generator) -> None:
    inputs = [
        normal(*shape, random=random, scale=0.2) for shape in ((1, 17, 3), (1, 3), *[(1, NODES, 3)] * 2)
    ]
    exact, single = deformation(*inputs), deformation(*(x.float() for x in inputs))
    assert single.garment.dtype == torch.float32
    assert (single.garment - exact.garment).abs().max() < 1e-5
    assert (single.landmarks - exact.landmarks).abs().max() < 1e-5


def test_parameters_that_do_not_fit_are_refused(deformation: Deformation) -> None:
    theta, alpha = torch.zeros(1, 17, 3), torch.zeros(1, 3)
    with pytest.raises(InputError, match="another skeleton"):
        deformation(theta[:, 1:], alpha)
    with pytest.raises(InputError, match="do not go together"):
        deformation(theta, alpha, torch.zeros(1, NODES, 3))
    with pytest.raises(InputError, match="do not go together"):
        deformation(theta, alpha, body_A=torch.zeros(1, 5, 3), body_T=torch.zeros(1, 5, 3))


# ---- skinning weights of the garment


def test_a_skirt_is_not_torn_between_the_legs(subject: Subject, skirt: Garment) -> None:
    """Evened-out weights stretch it less in a stride, and its waist stays on the body."""
    poses = make_motion(subject, "walk", 24, 24, 0)[14:20]
    transforms = joint_transforms(subject, poses)
    edges = Topology(len(skirt.rest_vertices), skirt.faces).edges
    a, b = edges.unbind(1)
    rest = (skirt.rest_vertices[a] - skirt.rest_vertices[b]).norm(dim=-1)

    def worn(smoothing: float) -> tuple[float, Tensor]:
        indices, weights = garment_skinning(skirt, subject, smoothing)
        torch.testing.assert_close(weights.sum(1), torch.ones(len(weights)).double())
        assert weights.min() >= 0
        arms = [j for j, name in enumerate(subject.joint_names) if "arm" in name or "finger" in name]
        assert not torch.isin(indices[weights > 0], torch.tensor(arms)).any()
        v = dual_quaternion_blend(skirt.rest_vertices, indices, weights, transforms)
        return float(((v[:, a] - v[:, b]).norm(dim=-1) / rest).max()), v

    torn, _ = worn(0.0)
    whole, vertices = worn(0.1)
    assert torn > 3
    assert whole < 2
    held = attached_targets(skirt, skin(subject, poses), subject.faces)
    assert (vertices[:, skirt.attached] - held).norm(dim=-1).max() < 1e-3


# ---- global translation


@pytest.mark.parametrize("views", [1, 3])
def test_known_translation_is_found(views: int, random: torch.Generator) -> None:
    cameras = [camera_at(0.5, 1.2, 3.0), camera_at(3.0, 1.0, 0.3), camera_at(-2.0, 2.0, -2.0)][:views]
    landmarks = normal(2, 9, 3, random=random, scale=0.4)
    truth = torch.tensor([[0.2, 0.9, -0.3], [-0.4, 1.1, 0.5]], dtype=torch.float64)
    pixels = torch.stack([camera.project(landmarks + truth[:, None]) for camera in cameras], 1)
    torch.testing.assert_close(global_translation(landmarks, cameras, pixels), truth)
    # A wrong detection, and one that is missing, without confidence.
    sigma = torch.rand(2, views, 9, dtype=torch.float64, generator=random) + 0.1
    sigma[0, 0, 3] = sigma[1, 0, 5] = 0
    pixels[0, 0, 3] += 50
    assert (global_translation(landmarks, cameras, pixels)[0] - truth[0]).norm() > 1e-3
    pixels[1, 0, 5] = torch.nan
    torch.testing.assert_close(global_translation(landmarks, cameras, pixels, sigma), truth)


def test_gradients_of_the_translation(random: torch.Generator) -> None:
    cameras = [camera_at(0.5, 1.2, 3.0), camera_at(3.0, 1.0, 0.3)]
    landmarks = normal(1, 4, 3, random=random, scale=0.4).requires_grad_()
    pixels = (100 + normal(1, 2, 4, 2, random=random, scale=20)).requires_grad_()
    sigma = torch.ones(1, 2, 4, dtype=torch.float64)
    sigma[0, 1, 2] = 0
    assert torch.autograd.gradcheck(
        lambda k, p: global_translation(k, cameras, p, sigma), (landmarks, pixels)
    )


def test_a_person_that_nobody_sees_is_not_placed() -> None:
    sigma = torch.tensor([[[1.0, 1.0]], [[1.0, 0.0]]])
    with pytest.raises(InputError, match="Too few 2D landmarks") as raised:
        global_translation(torch.zeros(2, 2, 3), [camera_at(0, 1, 3)], torch.zeros(2, 1, 2, 2), sigma)
    assert raised.value.where == "frame 1"


def test_root_angles_have_no_lock_when_a_person_turns_round(
    subject: Subject, deformation: Deformation
) -> None:
    """Turned about the vertical by anything, the other two angles stay 0."""
    turn = torch.linspace(-3, 3, 7, dtype=torch.float64)
    angles = torch.stack((0 * turn, 0 * turn, turn), -1)
    world = rest_poses(subject, 7).rotations
    world[:, 0] = roma.euler_to_rotmat(AXES, angles)
    lens = camera_at(0, 0.9, 3)
    found = parameters_of_poses(subject, from_world_axes(subject, world, torch.zeros(7, 3).double()), lens)
    torch.testing.assert_close(found.root, angles, atol=1e-6, rtol=0)
