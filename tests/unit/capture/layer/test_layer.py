"""The layer S: contact while the body moves, gradients through a step, batches, silhouettes."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

from tests.unit.capture.layer.conftest import body_and_garment, tilted
from toile.capture.garments import Garment, Material, attached_targets
from toile.capture.layer.layer import LayerSettings, SimulationLayer
from toile.capture.layer.silhouette import Outline, SilhouettePotential, SilhouetteRays
from toile.capture.layer.workers import LayerWorkers
from toile.errors import InputError
from toile.geometry.camera import Camera, looking_at
from toile.geometry.mesh import grid_faces
from toile.physics.contact.own import OwnContactSettings
from toile.physics.simulator import SimulationError
from toile.rendering import WarpRenderer

H = 1 / 120
TIGHT = LayerSettings(tolerance=1e-9)


@pytest.fixture(scope="module")
def swing():
    """A body that swings to and fro within 16 frames, and the garment's motion on it."""
    body, faces, garment = body_and_garment(14, 6)
    layer = SimulationLayer(garment, faces)
    angles = 0.5 * np.sin(2 * np.pi * np.arange(16) / 16)
    bodies = torch.stack([tilted(body, float(angle)) for angle in angles])
    return layer, bodies, layer.simulate(bodies, 30.0)


def test_a_swinging_body_stays_within_its_garment(swing) -> None:
    layer, bodies, motion = swing
    assert motion.converged.all()
    assert motion.converged.shape == (15, 4)
    depths, gaps = [], []
    for body, cloth in zip(bodies.numpy(), motion.garment_positions, strict=True):
        layer.contact.body.move(body)
        depths.append(layer.contact.surface(cloth[layer.contact.loose], 0.05).distances.min())
        layer.contact.cloth.move(cloth)
        gaps.append(layer.contact.facing(body, layer.contact.normals(body), 0.02)[1].min(initial=1.0))
    assert min(depths) > 0.0
    assert min(gaps) > -1e-4
    # It is pushed: without contact the body would come out of it.
    assert min(depths) < layer.settings.contact.thickness


def test_the_held_ring_goes_where_the_body_takes_it(swing) -> None:
    layer, _, motion = swing
    held = layer.garment.attached.numpy()
    start = layer.garment.rest_vertices[held]
    expected = torch.stack([tilted(start, 0.5 * np.sin(2 * np.pi * k / 16)) for k in range(16)])
    np.testing.assert_allclose(motion.garment_positions[:, held], expected, rtol=0, atol=1e-12)


def test_energy_stays_bounded_and_a_still_body_calms_down(swing) -> None:
    layer, bodies, motion = swing
    assert motion.kinetic.max() + motion.elastic.max() < 0.05
    still = layer.simulate(
        bodies[-1].expand(12, -1, -1),
        30.0,
        start=torch.from_numpy(motion.garment_positions[-1]),
        velocities=torch.from_numpy(motion.velocities),
    )
    assert still.kinetic[-1] < 0.02 * motion.kinetic.max()
    total = still.kinetic + still.elastic + still.gravitational
    assert np.all(np.diff(total) < 1e-6)


def test_a_motion_goes_on_from_where_it_was_cut(swing) -> None:
    layer, bodies, motion = swing
    first = layer.simulate(bodies[:12], 30.0)
    rest = layer.simulate(
        bodies[11:],
        30.0,
        start=torch.from_numpy(first.garment_positions[-1]),
        velocities=torch.from_numpy(first.velocities),
    )
    np.testing.assert_array_equal(rest.garment_positions[-1], motion.garment_positions[-1])


def scenes_of(motion, bodies: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Steps over a whole frame out of a motion."""
    x = torch.from_numpy(motion.garment_positions)
    frames = torch.tensor([5, 9, 13])
    return x[frames], (x[frames] - x[frames - 1]) * 30, bodies[frames], bodies[frames + 1]


@pytest.mark.parametrize("processes", [1, 2])
def test_a_batch_has_the_digits_of_singles(swing, processes: int) -> None:
    layer, bodies, motion = swing
    scenes = scenes_of(motion, bodies)
    with LayerWorkers(layer, processes) as workers, torch.no_grad():
        batch = workers.step_batch(*scenes, 1 / 30)
    for together, *scene in zip(batch, *scenes, strict=True):
        alone = layer.step(*scene, 1 / 30)
        assert torch.equal(alone.positions, together.positions)
        assert (alone.converged, alone.newton_steps) == (together.converged, together.newton_steps)


def test_a_step_does_not_depend_on_what_its_layer_did_before(swing) -> None:
    """The tree of boxes is made where a mesh is first; which of two equally near faces it finds is chance."""
    layer, bodies, motion = swing
    scenes = scenes_of(motion, bodies)
    ways = []
    for order in (1, -1):
        other = SimulationLayer(layer.garment, layer.body_faces)
        ways.append(
            [other.step(*scene, 1 / 30).positions for scene in list(zip(*scenes, strict=True))[::order]]
        )
    for first, second in zip(ways[0], ways[1][::-1], strict=True):
        assert torch.equal(first, second)


def test_gradients_do_not_cross_processes(swing) -> None:
    layer, bodies, motion = swing
    x, *others = scenes_of(motion, bodies)
    with pytest.raises(ValueError, match="gradients stay within a process"):
        LayerWorkers(layer, 2).step_batch(x.requires_grad_(), *others, 1 / 30)


def test_a_body_of_another_size_is_told(swing) -> None:
    layer, bodies, _ = swing
    with pytest.raises(InputError, match="Body does not fit the layer"):
        layer.simulate(bodies[:, :10], 30.0)


def test_a_start_inside_the_body_is_told(swing) -> None:
    layer, bodies, _ = swing
    inside = layer.garment.rest_vertices - torch.tensor([0.05, 0.0, 0.0])
    with pytest.raises(InputError, match="Garment starts inside the body"):
        layer.simulate(bodies[:2], 30.0, start=inside)


def touching_step():
    """A layer, and a step in the middle of the swing, where the cloth lies on the body and slides."""
    body, faces, garment = body_and_garment(12, 6, radii=(0.103, 0.103))
    layer = SimulationLayer(garment, faces, settings=TIGHT)
    angles = 0.5 * np.sin(2 * np.pi * np.arange(16) / 16)
    bodies = torch.stack([tilted(body, float(angle)) for angle in angles])
    motion = layer.simulate(bodies[:5], 30.0)
    x = torch.from_numpy(motion.garment_positions[-1])
    v = torch.from_numpy(motion.velocities)
    # Nothing is symmetric any more, so that no vertex is as near to one face as to another.
    generator = torch.Generator().manual_seed(5)
    x, before, after = (
        p + 2e-4 * torch.randn(p.shape, generator=generator, dtype=torch.float64)
        for p in (x, bodies[4], torch.lerp(bodies[4], bodies[5], 0.25))
    )
    return layer, x, v, before, after


INPUTS = {
    "positions": 1e-7,
    "velocities": 1e-5,
    "body": 1e-7,
    "next_body": 1e-7,
    "attached": 1e-7,
    "material": 1e-5,
    "friction": 1e-4,
}
"""What a step is differentiable by, and how far finite differences go: no pair changes on the way."""


@pytest.mark.parametrize("name", INPUTS)
def test_gradients_through_a_step_are_those_of_finite_differences(name: str) -> None:
    """Of the whole step: contacts are found anew in all its passes, planes and friction follow."""
    layer, x, v, before, after = touching_step()
    given = {
        "positions": x,
        "velocities": v,
        "body": before,
        "next_body": after,
        "attached": attached_targets(layer.garment, after, layer.body_faces),
        "material": layer.material.values,
        "friction": torch.tensor(0.3, dtype=torch.float64),
    }
    generator = torch.Generator().manual_seed(0)
    weights = torch.randn(x.shape, generator=generator, dtype=torch.float64)

    def outcome(values: dict[str, Tensor]) -> Tensor:
        step = layer.step(
            *(values[name] for name in ("positions", "velocities", "body", "next_body")),
            H,
            # Moves with the body where nothing else is asked for.
            attached=values["attached"] if name == "attached" else None,
            material=replace(layer.material, values=values["material"]),
            friction=values["friction"],
        )
        assert step.converged
        assert step.contacts > 5
        return (weights * step.positions).sum()

    leaf = given[name].clone().requires_grad_()
    gradient = torch.autograd.grad(outcome({**given, name: leaf}), leaf)[0]
    direction = torch.randn(leaf.shape, generator=generator, dtype=torch.float64)
    size = INPUTS[name] * (given[name].abs() if name == "material" else torch.ones_like(given[name]))
    with torch.no_grad():
        ends = [outcome({**given, name: given[name] + sign * size * direction}) for sign in (1.0, -1.0)]
    expected = float(ends[0] - ends[1]) / 2
    assert abs(expected) > 1e-12
    assert float((gradient * size * direction).sum()) == pytest.approx(expected, rel=1e-5)


def test_planes_in_torch_are_those_of_the_solver() -> None:
    """Before and after they are renewed, of vertices, edges and faces."""
    layer, x, v, before, after = touching_step()
    contact = layer.contact.begin(x.numpy(), before, after, 0.3, H, (x + H * v).numpy())
    for cloth in (x, x + H * v):
        planes = contact.pairs.planes(cloth, before, after, layer.contact.rules)
        assert min(len(contact.pairs.vertices), len(contact.pairs.edges), len(contact.pairs.facing)) > 10
        for name in ("vertices", "weights", "normals", "offsets", "stiffness", "normal_forces", "drags"):
            expected = getattr(contact.potential.planes, name)
            np.testing.assert_allclose(getattr(planes, name), expected, rtol=0, atol=1e-11, err_msg=name)
        forces = contact.forces(cloth, x, cloth).numpy()
        np.testing.assert_allclose(forces, -contact.potential.gradient(cloth.numpy()), rtol=0, atol=1e-9)
        assert np.abs(forces).max() > 1e-3
        contact.renew((x + H * v).numpy())


def test_what_has_no_gradients_says_so() -> None:
    layer, x, v, before, after = touching_step()
    given = v, before, after.requires_grad_(), H
    settings = LayerSettings(own_contact=OwnContactSettings())
    folding = SimulationLayer(layer.garment, layer.body_faces, settings=settings)
    with pytest.raises(InputError, match="No gradients through contact of a garment with itself"):
        folding.step(x, *given)
    hasty = SimulationLayer(layer.garment, layer.body_faces, settings=LayerSettings(1e-12, 1.0, 1))
    step = hasty.step(x, *given)
    assert not step.converged
    with pytest.raises(SimulationError, match="did not converge"):
        step.positions.sum().backward()


def ring_of_cameras(n: int) -> list[Camera]:
    plain = Camera(200.0, 200.0, 64.0, 64.0, 128, 128)
    up = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    eyes = [(1.5 * np.cos(a), -0.1, 1.5 * np.sin(a)) for a in 2 * np.pi * (np.arange(n) + 0.5) / n]
    centre = torch.tensor([0.0, -0.1, 0.0], dtype=torch.float64)
    return [looking_at(plain, torch.tensor(eye, dtype=torch.float64), centre, up) for eye in eyes]


def seen(layer: SimulationLayer, cloth: Tensor, body: Tensor, cameras: list[Camera]) -> list[SilhouetteRays]:
    """Silhouettes of a garment on its body."""
    vertices = torch.cat((cloth, body)).float()
    faces = torch.cat((layer.garment.faces, layer.body_faces + len(cloth)))
    rays = []
    for camera in cameras:
        face = WarpRenderer().rasterize(vertices[None], faces, camera).face[0].numpy()
        garment = (face >= 0) & (face < len(layer.garment.faces))
        rays.append(SilhouetteRays.of_mask(camera, garment, face >= 0))
    return rays


def distance(layer: SimulationLayer, rays: list[SilhouetteRays], x: Tensor) -> float:
    """Mean over the pixels of Eq. 1 across the outline, with the vertices that are nearest now [m²]."""
    potential = SilhouettePotential(
        Outline(layer.cloth.topology, layer.contact.body), rays, 1.0, 0.0, 0.1, x.numpy()
    )
    return potential.total(x.numpy(), np.ones(x.shape)) / sum(len(view.directions) for view in rays)


def test_silhouettes_draw_the_outline_to_the_rays() -> None:
    """Eq. 1 with silhouettes of the garment swung aside, the more so the more weight it has."""
    body, faces, garment = body_and_garment(16, 6)
    aside = garment.rest_vertices.clone()
    aside[:, 0] += 0.08 * (0.05 - aside[:, 1])
    rays = seen(SimulationLayer(garment, faces), aside, body, ring_of_cameras(2))
    left = []
    for weight in (1e-6, 0.3, 5.0):
        layer = SimulationLayer(garment, faces, settings=LayerSettings(silhouette_weight=weight))
        x = garment.rest_vertices
        layer.contact.body.move(body.numpy())
        for _ in range(2):
            step = layer.step(x, torch.zeros_like(x), body, body, 1 / 30, silhouettes=rays)
            assert step.converged
            x = step.positions
        left.append(distance(layer, rays, x))
    assert left[2] < left[1] < left[0]
    assert left[2] < 0.5 * left[0], left
    # What is left where the cloth is the one that was seen: pixels, and distances between vertices.
    assert distance(layer, rays, aside) < 0.6 * left[0]


def test_the_silhouette_potential_has_its_gradient() -> None:
    body, faces, garment = body_and_garment(12, 5)
    layer = SimulationLayer(garment, faces)
    layer.contact.body.move(body.numpy())
    x = garment.rest_vertices.numpy()
    rays = seen(layer, garment.rest_vertices + torch.tensor([0.01, 0.0, 0.0]), body, ring_of_cameras(3))
    outline = Outline(layer.cloth.topology, layer.contact.body)
    potential = SilhouettePotential(outline, rays, 2.0, 0.3, 0.1, x)
    free = np.ones(x.shape)
    generator = np.random.default_rng(0)
    at, direction = x + 0.01 * generator.normal(size=x.shape), generator.normal(size=x.shape)
    ends = [potential.total(at + sign * 1e-5 * direction, free) for sign in (1.0, -1.0)]
    assert (ends[0] - ends[1]) / 2e-5 == pytest.approx((potential.gradient(at) * direction).sum(), rel=1e-6)
    assert np.abs(potential.gradient(x)).max() > 0.0


def test_pixels_of_the_body_are_no_silhouette_of_the_garment() -> None:
    camera = Camera(100.0, 100.0, 4.0, 4.0, 8, 8)
    garment = np.zeros((8, 8), bool)
    garment[3:5, 2:6] = True
    person = garment.copy()
    person[1:3, 2:6] = True
    rays = SilhouetteRays.of_mask(camera, garment, person)
    # The sides and the lower edge, not the upper one, which the body continues.
    assert len(rays.directions) == 2 + 2 + 4
    assert rays.directions[:, 1].min() > -0.01 / 1


def draped_on_a_ball(n: int) -> Tensor:
    """Where a soft square of n² vertices rests on a ball (n, n, 3) [m]."""
    ball = trimesh.creation.icosphere(4, 0.25)
    at = torch.linspace(-0.1, 0.1, n, dtype=torch.float64)
    z, x = torch.meshgrid(at, at, indexing="ij")
    rest = torch.stack((x, torch.full_like(x, 0.256), z), -1).reshape(-1, 3)
    none, index = torch.zeros(0, 3, dtype=torch.float64), torch.zeros(0, dtype=torch.int64)
    soft = Material(young=50.0, bending=3e-4, friction=0.3)
    garment = Garment(rest, grid_faces(n, n), index, index, none, none, soft)
    layer = SimulationLayer(garment, torch.from_numpy(np.array(ball.faces, np.int64)))
    motion = layer.simulate(torch.from_numpy(np.array(ball.vertices)).expand(25, -1, -1), 30.0, 1)
    assert motion.converged.all()
    return torch.from_numpy(motion.garment_positions[-1]).reshape(n, n, 3)


def test_a_draped_sheet_converges_under_refinement() -> None:
    """`make capture-layer` has the same with a finer one."""
    finest = draped_on_a_ball(17)
    errors = []
    for n in (3, 5, 9):
        every = 16 // (n - 1)
        away = draped_on_a_ball(n) - finest[::every, ::every]
        errors.append(float(away.square().sum(-1).mean().sqrt()))
    assert errors[1] < 0.6 * errors[0]
    assert errors[2] < 0.5 * errors[1]
    assert errors[2] < 3e-4
    # It lies on the ball.
    assert float(finest.norm(dim=-1).min()) > 0.25
    assert float(finest[8, 8].norm()) < 0.2535
