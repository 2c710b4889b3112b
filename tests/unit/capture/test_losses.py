"""Losses of the two networks: values by hand, gradients, and the mistakes that each invites."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

from toile.capture.body.limits import rotation_of_angles
from toile.capture.deformation.graph import EmbeddedGraph, embedded_graph
from toile.capture.garments import Garment, Material
from toile.capture.layer.layer import GRAVITY, SimulationLayer
from toile.capture.losses.attachment import attachment_loss
from toile.capture.losses.balance import potential_loss
from toile.capture.losses.joint_limits import joint_limit_loss
from toile.capture.losses.landmarks import landmark_loss
from toile.capture.losses.rigidity import rigidity_loss, rotation_loss
from toile.capture.losses.silhouette import (
    Boundary,
    BoundaryFinder,
    alignment,
    distance_field,
    silhouette_loss,
)
from toile.capture.losses.simulation import (
    LayerFrameStep,
    Stepped,
    physics_loss,
    simulated_window,
    simulation_loss,
)
from toile.errors import InputError
from toile.geometry.camera import Camera, looking_at
from toile.geometry.mesh import grid_faces

TURN = 2 * math.pi
PLAIN = Camera(fx=10, fy=20, cx=0, cy=0, height=8, width=8)


@pytest.fixture
def random() -> torch.Generator:
    return torch.Generator().manual_seed(3)


def f64(*values: object) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def normal(*shape: int, random: torch.Generator, scale: float = 1.0) -> Tensor:
    return scale * torch.randn(*shape, dtype=torch.float64, generator=random)


# ---- landmarks, Eq. 4


def test_landmarks_by_hand() -> None:
    """Pixel (5, 10) and (2, 8) off by (1, 2) and (0, 3); the second camera, moved 1 m back, sees half."""
    points = f64([[0.5, 0.5, 1], [0.2, 0.4, 1]])
    back = replace(PLAIN, translation=(0.0, 0.0, 1.0))
    seen = torch.stack((f64([4, 8], [2, 5]), f64([2.5, 5], [1, 4])))[None]
    assert float(landmark_loss(points, [PLAIN, back], seen)) == pytest.approx(1 + 4 + 9)
    sigma = f64([[0.5, 0], [1, 1]])
    seen[0, 0, 1] = torch.nan
    assert float(landmark_loss(points, [PLAIN, back], seen, sigma)) == pytest.approx(0.5 * (1 + 4))
    # The mean over frames, the sum over everything else.
    twice = landmark_loss(
        points.repeat(2, 1, 1), [PLAIN, back], seen.repeat(2, 1, 1, 1), sigma.repeat(2, 1, 1)
    )
    assert float(twice) == pytest.approx(2.5)


def test_gradients_of_landmarks(random: torch.Generator) -> None:
    points = (normal(2, 3, 3, random=random, scale=0.2) + f64(0, 0, 2)).requires_grad_()
    seen = normal(2, 2, 3, 2, random=random)
    sigma = torch.rand(2, 2, 3, dtype=torch.float64, generator=random)
    sigma[0, 1, 2], seen[0, 1, 2] = 0, torch.nan
    cameras = [PLAIN, replace(PLAIN, translation=(0.1, 0.0, 1.0))]
    assert torch.autograd.gradcheck(lambda p: landmark_loss(p, cameras, seen, sigma), points)


# ---- silhouette, Eq. 5


def test_distance_to_a_straight_outline() -> None:
    mask = torch.arange(8).expand(6, 8) < 3
    expected = (torch.arange(8).double() + 0.5 - 3).expand(6, 8)
    torch.testing.assert_close(distance_field(mask), expected)
    # Nothing there, or no background: no outline, and the image's border is none.
    assert not distance_field(torch.zeros(6, 8, dtype=torch.bool)).any()
    assert not distance_field(torch.ones(6, 8, dtype=torch.bool)).any()


@pytest.mark.parametrize(
    ("outward", "rho"), [((1, 0), 1.0), ((0.5, 0.75**0.5), 0.5), ((0, 1), 0.0), ((-1, 0), 0.0)]
)
def test_silhouette_by_hand(outward: tuple[float, float], rho: float) -> None:
    """A vertex at pixel (5, 4), two pixels out of a mask; its normal at 0°, 60°, 90°, 180° to ∇D."""
    field = distance_field(torch.arange(8).expand(8, 8) < 3)
    # The pixels are not square: a direction in the world is steeper in the image.
    way = f64([outward[0] / PLAIN.fx, outward[1] / PLAIN.fy, 0])
    seen = Boundary(torch.tensor([0]), torch.nn.functional.normalize(way))
    loss = silhouette_loss(f64([[0.5, 0.2, 1]]), [[seen]], [PLAIN], field[None, None])
    assert float(loss) == pytest.approx(rho * 4)
    assert float(alignment(f64(1, 0), f64(*outward))) == pytest.approx(rho)


def test_what_is_out_of_the_image_or_behind_says_nothing() -> None:
    field = distance_field(torch.arange(8).expand(8, 8) < 3)[None, None]
    seen = Boundary(torch.tensor([0]), f64([1, 0, 0]))
    for place in ([0.9, 0.2, 1], [-0.5, -0.2, -1], [0.5, 0.2, 0]):
        point = f64([place]).requires_grad_()
        loss = silhouette_loss(point, [[seen]], [PLAIN], field)
        (gradient,) = torch.autograd.grad(loss, point)
        assert loss.item() == 0
        assert torch.equal(gradient, torch.zeros_like(gradient))


def test_gradients_of_the_silhouette() -> None:
    """Two sides of a mask; vertices off the borders of pixels, where the sampled distance has kinks.

    ρ has no gradients, so it must not change here: the outlines are straight, the normals askew.
    """
    column = torch.arange(12).expand(8, 12)
    fields = distance_field((column >= 3) & (column < 9)).expand(2, 2, 8, 12)
    wide = replace(PLAIN, width=12)
    pixels = f64(
        [[1.8, 3.3], [4.1, 5.2], [7.7, 2.2], [10.2, 6.1]], [[2.2, 3.9], [3.7, 6.1], [9.2, 4.8], [8.3, 1.9]]
    )
    vertices = torch.cat((pixels / f64(10, 20), torch.ones(2, 4, 1).double()), -1).requires_grad_()
    seen = Boundary(torch.arange(4), f64([-0.6, 0.8, 0], [-1, 0, 0], [0.8, 0.6, 0], [0.8, -0.6, 0]))
    views = [[seen, replace(seen, vertices=seen.vertices.flip(0), outward=seen.outward.flip(0))]] * 2
    assert torch.autograd.gradcheck(
        lambda v: silhouette_loss(v, views, [wide, wide], fields), vertices, eps=1e-7, atol=1e-6
    )
    (found,) = torch.autograd.grad(silhouette_loss(vertices, views, [wide, wide], fields), vertices)
    assert found[..., 0].abs().min() > 0


SPHERE = trimesh.creation.icosphere(2, 0.1)
TINY = trimesh.creation.icosphere(0, 0.01)
EYE = looking_at(Camera(400, 400, 48, 32, 64, 96), f64(0, 0, 2), f64(0, 0, 0), f64(0, 1, 0))


def sphere_mask(x: float) -> Tensor:
    """Of a sphere that is x to the right in the image [px]; its radius is 20 pixels."""
    row, column = torch.meshgrid(torch.arange(64) + 0.5, torch.arange(96) + 0.5, indexing="ij")
    return (column - 48 - x) ** 2 + (row - 32) ** 2 < 20.0**2


def finder_of(body: trimesh.Trimesh) -> tuple[BoundaryFinder, Tensor, Tensor]:
    faces = torch.from_numpy(np.array(SPHERE.faces, np.int64))
    body_faces = torch.from_numpy(np.array(body.faces, np.int64))
    finder = BoundaryFinder(faces, len(SPHERE.vertices), body_faces, len(body.vertices))
    return finder, torch.from_numpy(np.array(SPHERE.vertices)), torch.from_numpy(np.array(body.vertices))


def test_boundary_of_a_sphere_in_two_cameras() -> None:
    finder, sphere, body = finder_of(TINY)
    side = looking_at(Camera(400, 400, 48, 32, 64, 96), f64(2, 0, 0), f64(0, 0, 0), f64(0, 1, 0))
    for camera, seen in zip((EYE, side), finder(sphere, body, [EYE, side]), strict=True):
        assert len(seen.vertices) > 12
        place = sphere[seen.vertices]
        view = torch.nn.functional.normalize(place - camera.centre, dim=-1)
        normal_ = torch.nn.functional.normalize(place, dim=-1)
        # Where the surface turns away, to the length of an edge; the background lies outward.
        assert (view * normal_).sum(-1).abs().max() < 0.3
        assert (seen.outward * normal_).sum(-1).min() > 0.9
    wall = trimesh.creation.box((3, 3, 0.1))
    finder, sphere, body = finder_of(wall)
    assert len(finder(sphere, body - f64(0, 0, 0.5), [EYE])[0].vertices) == 0


def test_the_sign_of_rho_decides_where_the_sphere_goes() -> None:
    """The mask is 1.4 radii to the left: the sphere's left side is nearest to the mask's right outline.

    By the normal test the sides find each other and the sphere goes left. With the sign of ρ turned round the
    left side is drawn to the right outline of the mask, and the sphere goes the wrong way.
    """
    finder, sphere, body = finder_of(TINY)
    field = distance_field(sphere_mask(-28))[None, None]

    def slope(boundary: Boundary) -> Tensor:
        shift = torch.zeros(3, dtype=torch.float64, requires_grad=True)
        loss = silhouette_loss((sphere + shift)[None], [[boundary]], [EYE], field)
        return torch.autograd.grad(loss, shift)[0]

    (seen,) = finder(sphere, body, [EYE])
    assert slope(seen)[0] > 1  # downhill is to the left
    assert slope(replace(seen, outward=-seen.outward))[0] < -1
    # And going downhill ends on the mask.
    place = torch.zeros(3, dtype=torch.float64)
    for _ in range(25):
        (seen,) = finder(sphere + place, body, [EYE])
        shift = torch.zeros(3, dtype=torch.float64, requires_grad=True)
        loss = silhouette_loss((sphere + place + shift)[None], [[seen]], [EYE], field)
        (gradient,) = torch.autograd.grad(loss, shift)
        # A step of Newton's for vertices whose distance changes as they move, half of them along x.
        place = place - gradient * f64(1, 1, 0) / (len(seen.vertices) * 200.0**2)
    torch.testing.assert_close(place, f64(-0.14, 0, 0), atol=4e-3, rtol=0)


# ---- regularisers of the graph


def chain(u: tuple[float, float] = (2.0, 3.0)) -> EmbeddedGraph:
    """Three nodes in a row along x, 1 m apart."""
    none = torch.zeros(3, 1, dtype=torch.int64)
    return EmbeddedGraph(
        vertices=torch.arange(3),
        positions=f64([0, 0, 0], [1, 0, 0], [2, 0, 0]),
        indices=none,
        weights=none.double(),
        edges=torch.tensor([[0, 1], [1, 2]]),
        rigidity=f64(*u),
    )


def test_rigidity_by_hand() -> None:
    A, T = torch.zeros(1, 3, 3).double(), torch.zeros(1, 3, 3).double()
    T[0, 2, 1] = 0.1  # seen from both ends of edge 1-2
    assert float(rigidity_loss(chain(), A, T)) == pytest.approx(2 * 3 * 0.1**2)
    A[0, 0, 1] = math.pi / 2  # about z, order XZY: node 0 expects node 1 at (0, 1, 0) instead of (1, 0, 0)
    assert float(rigidity_loss(chain(), A, T)) == pytest.approx(2 * 3 * 0.1**2 + 2 * 2.0)
    assert float(rotation_loss(chain(), A)) == pytest.approx(2 * 0.5 * 4)  # four entries differ by 1
    assert float(rigidity_loss(chain(), A.repeat(2, 1, 1), T.repeat(2, 1, 1))) == pytest.approx(4.06)


def test_moving_all_of_it_rigidly_costs_nothing(random: torch.Generator) -> None:
    A = normal(1, 1, 3, random=random).expand(1, 3, 3)
    g, R = chain().positions, rotation_of_angles(A[0, 0])
    T = (g @ R.T + normal(3, random=random) - g)[None]
    assert float(rigidity_loss(chain(), A, T)) < 1e-25
    assert float(rigidity_loss(chain(), -A, T)) > 0.1
    assert float(rotation_loss(chain(), A)) == 0


def test_whole_turns_cost_nothing(random: torch.Generator) -> None:
    """A neighbour at 3.1 rad and one at -3.1 rad are 0.083 rad apart, not 6.2."""
    A, T = normal(1, 3, 3, random=random), normal(1, 3, 3, random=random)
    turned = A.clone()
    turned[0, 1] += f64(TURN, -TURN, 2 * TURN)
    torch.testing.assert_close(rotation_loss(chain(), turned), rotation_loss(chain(), A))
    torch.testing.assert_close(rigidity_loss(chain(), turned, T), rigidity_loss(chain(), A, T))
    near = torch.zeros(1, 3, 3, dtype=torch.float64)
    near[0, :, 2] = f64(3.1, -3.1, -3.1)
    small = 4 * 2.0 * math.sin((TURN - 6.2) / 2) ** 2
    assert float(rotation_loss(chain(), near)) == pytest.approx(small)
    assert small == pytest.approx(2.0 * (TURN - 6.2) ** 2, rel=1e-3)


def test_gradients_of_the_regularisers(random: torch.Generator) -> None:
    A, T = (normal(2, 3, 3, random=random).requires_grad_() for _ in range(2))
    assert torch.autograd.gradcheck(lambda a, t: rigidity_loss(chain(), a, t), (A, T))
    assert torch.autograd.gradcheck(lambda a: rotation_loss(chain(), a), A)


# ---- attachment, Eq. 6


def test_attachment_by_hand_and_its_gradients(random: torch.Generator) -> None:
    garment, targets = torch.zeros(2, 4, 3).double(), torch.zeros(2, 2, 3).double()
    garment[0, 3], targets[0, 1], garment[0, 1] = f64(0, 0, 3), f64(0, 4, 0), f64(9, 9, 9)
    attached = torch.tensor([0, 3])
    assert float(attachment_loss(garment, attached, targets)) == pytest.approx((9 + 16) / 2)
    inputs = normal(2, 4, 3, random=random).requires_grad_(), normal(2, 2, 3, random=random).requires_grad_()
    assert torch.autograd.gradcheck(lambda g, t: attachment_loss(g, attached, t), inputs)


# ---- limits of the joints


LIMITS = f64([[-1, 0.5], [-math.inf, math.inf], [-math.inf, 2]], [[0, 2], [-0.1, 0.1], [-3, 3]])


def test_joint_limits_by_hand() -> None:
    angles = f64([[0.8, 50, 2.5], [-0.2, 0.05, 0]])
    assert float(joint_limit_loss(angles, LIMITS)) == pytest.approx(0.3**2 + 0.5**2 + 0.2**2)
    assert float(joint_limit_loss(f64([[0, 0, 0], [1, 0, 0]]), LIMITS)) == 0


def test_whole_turns_of_a_joint_are_the_same_pose() -> None:
    angles = f64([[0.8, 1, 1], [-0.2, 0.05, 0]])
    turns = f64([[TURN, TURN, 0], [-TURN, 2 * TURN, -TURN]])
    once = joint_limit_loss(angles, LIMITS)
    torch.testing.assert_close(joint_limit_loss(angles + turns, LIMITS), once)


def test_gradients_of_the_joint_limits(random: torch.Generator) -> None:
    angles = normal(3, 2, 3, random=random, scale=2).requires_grad_()
    assert torch.autograd.gradcheck(lambda a: joint_limit_loss(a, LIMITS), angles)
    assert joint_limit_loss(angles, LIMITS) > 0


# ---- simulation, Eq. 8

H = 0.5
G = f64(0, -10, 0)


def fall(positions: Tensor, velocities: Tensor, body: Tensor, next_body: Tensor, frame: int) -> Stepped:
    """Implicit Euler without forces but gravity, carried by the body's first vertex."""
    carried = next_body[0] - body[0]
    return Stepped(positions + H * velocities + H * H * G + carried, True)


def test_the_window_starts_with_the_network_and_goes_on_simulated(random: torch.Generator) -> None:
    """Eq. 8's three cases, told by what S is called with."""
    V, bodies = normal(4, 2, 3, random=random), normal(4, 5, 3, random=random)
    calls: list[tuple[Tensor, Tensor, Tensor, Tensor, int]] = []

    def step(x: Tensor, v: Tensor, body: Tensor, after: Tensor, frame: int) -> Stepped:
        calls.append((x, v, body, after, frame))
        return fall(x, v, body, after, frame)

    window = simulated_window(V, bodies, step, H)
    assert [call[4] for call in calls] == [1, 2, 3]
    S = window.positions
    torch.testing.assert_close(S[0], V[0])
    torch.testing.assert_close(calls[0][:2], (V[0], (V[1] - V[0]) / H))
    torch.testing.assert_close(calls[1][:2], (S[1], (S[1] - S[0]) / H))
    torch.testing.assert_close(calls[2][:2], (S[2], (S[2] - S[1]) / H))
    for t, call in enumerate(calls, 1):
        torch.testing.assert_close(call[2:4], (bodies[t - 1], bodies[t]))
        torch.testing.assert_close(S[t], fall(*call).positions)
    assert window.counts.tolist() == [False, True, True, True]


def test_simulation_by_hand() -> None:
    """One vertex at rest for three frames; S drops it by 2.5 m, then by 5 m more."""
    V, bodies = torch.zeros(3, 1, 3).double(), torch.zeros(3, 1, 3).double()
    assert float(physics_loss(V, bodies, fall, H)) == pytest.approx(2.5**2 + 7.5**2)


def test_no_gradients_through_the_simulation_unless_asked_for(random: torch.Generator) -> None:
    V, bodies = normal(3, 2, 3, random=random).requires_grad_(), normal(3, 1, 3, random=random)
    bodies.requires_grad_()
    simulated = simulated_window(V, bodies, fall, H).positions
    assert not simulated.requires_grad
    (found,) = torch.autograd.grad(physics_loss(V, bodies, fall, H), V)
    expected = 2 * (V - simulated).detach()
    expected[0] = 0  # the first frame is not supervised
    torch.testing.assert_close(found, expected)
    # Our variant: V moves Ṽ too, of the first frame and by the velocity. Then finite differences agree.
    (through,) = torch.autograd.grad(physics_loss(V, bodies, fall, H, through_step=True), V)
    assert (through - found).abs().max() > 0.1
    given = bodies.detach()
    assert torch.autograd.gradcheck(lambda v: physics_loss(v, given, fall, H, through_step=True), V)
    window = simulated_window(V, bodies, fall, H)
    assert torch.autograd.gradcheck(lambda v: simulation_loss(v, window), V)


@pytest.mark.parametrize("bad", ["not converged", "not finite"])
def test_a_step_that_fails_does_not_teach(bad: str, random: torch.Generator) -> None:
    """Nor do the frames after it, which would start from it."""
    V, bodies = normal(4, 2, 3, random=random).requires_grad_(), torch.zeros(4, 1, 3).double()

    def step(x: Tensor, v: Tensor, body: Tensor, after: Tensor, frame: int) -> Stepped:
        result = fall(x, v, body, after, frame)
        if frame != 2:
            return result
        return Stepped(result.positions, False) if bad == "not converged" else Stepped(x * torch.nan, True)

    window = simulated_window(V, bodies, step, H)
    assert window.counts.tolist() == [False, True, False, False]
    (found,) = torch.autograd.grad(simulation_loss(V, window), V)
    assert found[1].norm() > 1
    assert not found[[0, 2, 3]].any()


def test_a_window_of_one_frame_is_refused() -> None:
    one = torch.zeros(1, 1, 3).double()
    with pytest.raises(InputError, match="Window cannot be simulated"):
        simulated_window(one, one, fall, H)


def test_the_layer_as_a_step() -> None:
    """A cloth that the network lets hang in the air falls in S, two sub-steps of implicit Euler a frame."""
    u, v = torch.meshgrid(torch.arange(3), torch.arange(3), indexing="ij")
    flat = torch.stack((0.1 * u, 0 * u + 1.0, -0.1 * v), -1).double().reshape(-1, 3)
    none = torch.zeros(0, dtype=torch.int64)
    empty = torch.zeros(0, 3, dtype=torch.float64)
    cloth = Garment(flat, grid_faces(3, 3), none, none, empty, empty, Material(young=50.0))
    body = torch.from_numpy(np.array(TINY.vertices))
    layer = SimulationLayer(cloth, torch.from_numpy(np.array(TINY.faces, np.int64)))
    V = flat.repeat(3, 1, 1).requires_grad_()
    bodies = body.repeat(3, 1, 1)
    step = LayerFrameStep(layer, fps=30.0, substeps=2)
    loss = physics_loss(V, bodies, step, 1 / 30)
    h, frame = 1 / 60, 1 / 30
    first = 3 * GRAVITY * h * h  # 1 + 2 after two sub-steps
    # The next frame starts with the mean velocity of the one before, as Eq. 8 has it.
    second = first + frame * (first / frame) + first
    assert loss.item() == pytest.approx(9 * (first**2 + second**2), rel=1e-6)
    (found,) = torch.autograd.grad(loss, V)
    torch.testing.assert_close(found[1, :, 1], torch.full((9,), 2 * first).double(), rtol=1e-6, atol=0)


# ---- incremental potential


def hanging_cloth() -> tuple[SimulationLayer, Tensor, Tensor]:
    """A cloth of 3 × 3 vertices one metre up, one corner held, and a body far below it."""
    u, v = torch.meshgrid(torch.arange(3), torch.arange(3), indexing="ij")
    flat = torch.stack((0.1 * u, 0 * u + 1.0, -0.1 * v), -1).double().reshape(-1, 3)
    none = torch.zeros(0, dtype=torch.int64)
    empty = torch.zeros(0, 3, dtype=torch.float64)
    cloth = Garment(flat, grid_faces(3, 3), none, none, empty, empty, Material(young=50.0))
    layer = SimulationLayer(cloth, torch.from_numpy(np.array(TINY.faces, np.int64)))
    return layer, flat, torch.from_numpy(np.array(TINY.vertices))


def test_potential_has_the_gradient_of_its_parts(random: torch.Generator) -> None:
    layer, flat, body = hanging_cloth()
    V = flat.repeat(3, 1, 1) + 0.01 * normal(3, 9, 3, random=random)
    # Close to the body: some vertices touch it. Far away they do not.
    for lift in (0.0, float(body[:, 1].max()) - 1.0):
        moved = (V + torch.tensor([0.0, lift, 0.0]).double()).requires_grad_()
        bodies = body.repeat(3, 1, 1)
        (found,) = torch.autograd.grad(potential_loss(layer, moved, bodies, H), moved)
        step = 1e-6
        for t, i, k in ((1, 4, 1), (2, 0, 0), (2, 8, 1), (0, 3, 2)):
            two = []
            for sign in (1, -1):
                other = moved.detach().clone()
                other[t, i, k] += sign * step
                # The past is given: only what the frame itself adds is differentiated.
                terms = potential_loss(layer, other, bodies, H)
                if t < 2:
                    past = other[2] - 2 * other[1] + other[0]
                    terms = terms - 0.5 * (layer.cloth.masses[:, None] * past.square()).sum() / (2 * H**2)
                two.append(float(terms))
            assert float(found[t, i, k]) == pytest.approx((two[0] - two[1]) / (2 * step), rel=1e-4, abs=1e-7)


def test_what_the_layer_simulates_is_least_in_its_potential(random: torch.Generator) -> None:
    """Implicit Euler's step is the minimum: forces vanish there, and elsewhere there is more of it."""
    layer, flat, body = hanging_cloth()
    before = flat + 0.005 * normal(9, 3, random=random)
    moved = before + 0.002 * normal(9, 3, random=random)
    step = layer.step(moved, (moved - before) / H, body, body, H)
    assert step.converged
    V = torch.stack((before, moved, step.positions)).requires_grad_()
    bodies = body.repeat(3, 1, 1)
    loss = potential_loss(layer, V, bodies, H)
    (found,) = torch.autograd.grad(loss, V)
    weight = float(layer.cloth.masses.max()) * GRAVITY
    assert float(found[2].abs().max()) < 1e-3 * weight
    assert float(found[0].abs().max()) == 0.0
    for _ in range(5):
        other = V.detach().clone()
        other[2] += 1e-3 * normal(9, 3, random=random)
        assert float(potential_loss(layer, other, bodies, H)) > float(loss.detach())


def test_a_window_of_one_frame_has_no_potential() -> None:
    layer, flat, body = hanging_cloth()
    with pytest.raises(InputError, match="Window has no potential"):
        potential_loss(layer, flat[None], body[None], H)


# ---- together


def test_losses_of_a_garment_reach_the_nodes(random: torch.Generator) -> None:
    """A, T of a graph on a real mesh through the deformation into a loss, in single precision."""
    vertices = torch.from_numpy(np.array(SPHERE.vertices))
    graph = embedded_graph(vertices, torch.from_numpy(np.array(SPHERE.faces, np.int64)), 8)
    A, T = (normal(2, 8, 3, random=random, scale=0.1).float().requires_grad_() for _ in range(2))
    loss = rigidity_loss(graph, A, T) + rotation_loss(graph, A)
    assert loss.dtype == torch.float32
    for gradient in torch.autograd.grad(loss, (A, T)):
        assert gradient.abs().min() > 0
