"""Contact of a cloth with itself: its derivatives, action and reaction, layers that don't pass through."""

from itertools import combinations

import numpy as np
import pytest
import torch
from torch import Tensor

from toile.capture.garments.garment import Garment, Material
from toile.capture.layer.layer import GRAVITY, LayerSettings, SimulationLayer
from toile.errors import InputError
from toile.geometry.mesh import grid_faces
from toile.geometry.self_proximity import SelfProximity
from toile.physics.contact.own import OwnContact, OwnContactSettings
from toile.physics.contact.planes import ContactPotential, Penalty
from toile.physics.implicit.linear_solvers.pattern import BlockPattern
from toile.physics.topology import Topology

SETTINGS = OwnContactSettings()
PENALTY = Penalty(smoothing=5e-4, hardening=1e-3)
FLOOR = torch.tensor([[-9.0, 0, -9], [-9, 0, 9], [9, 0, 9], [9, 0, -9]], dtype=torch.float64)
FLOOR_FACES = torch.tensor([[0, 1, 2], [0, 2, 3]])


def two_patches(apart: float, n: int = 4) -> tuple[Tensor, Tensor]:
    """Two squares above each other, the upper one a little turned and moved: vertices and faces."""
    at = 0.012 * torch.arange(n, dtype=torch.float64)
    x, z = torch.meshgrid(at, at, indexing="ij")
    low = torch.stack((x, torch.zeros_like(x), z), -1).reshape(-1, 3)
    c, s = np.cos(0.3), np.sin(0.3)
    turn = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]], dtype=torch.float64)
    high = low @ turn.T + torch.tensor([0.003, apart, 0.004])
    faces = grid_faces(n, n)
    return torch.cat((low, high)), torch.cat((faces, faces + n * n))


def free_garment(vertices: Tensor, faces: Tensor, **material: float) -> Garment:
    """Held nowhere."""
    none, index = torch.zeros(0, 3, dtype=torch.float64), torch.zeros(0, dtype=torch.int64)
    return Garment(vertices, faces, index, index, none, none, Material(**{"young": 200.0, **material}))


def folded(along: int, across: int, gap: float) -> tuple[Tensor, Tensor]:
    """A strip above the floor, folded over itself: vertices and faces."""
    spacing, radius = 0.012, gap / 2
    turn = np.pi * np.arange(1, 4) / 4
    flat = spacing * np.arange(along)
    x = np.concatenate((flat, flat[-1] + radius * np.sin(turn), flat[::-1]))
    y = np.concatenate((np.zeros(along), radius - radius * np.cos(turn), np.full(along, gap))) + 0.004
    z = spacing * np.arange(across)
    rows = [np.repeat(a[:, None], across, 1) for a in (x, y)]
    vertices = np.stack((*rows, np.repeat(z[None], len(x), 0)), -1).reshape(-1, 3)
    return torch.from_numpy(vertices), grid_faces(len(x), across)


def crumpled() -> tuple[OwnContact, np.ndarray]:
    """Two patches that nearly touch, bent at random, and what finds their contacts."""
    vertices, faces = two_patches(0.0014)
    generator = np.random.default_rng(2)
    x = vertices.numpy() + 2e-4 * generator.normal(size=vertices.shape)
    masses = generator.uniform(1e-5, 3e-5, len(x))
    topology = Topology(len(x), faces)
    return OwnContact(topology, masses, np.ones(len(x), np.bool_), PENALTY, SETTINGS), x


def test_the_gradient_is_that_of_the_distances() -> None:
    """Of U = Σ 2 k φ((t - distance) / 2) over all pairs, though the planes are frozen."""
    contact, x = crumpled()
    planes = contact.planes(x, x, x)
    potential = ContactPotential(planes, x, 0.0, PENALTY, 1e-4)
    keys = planes.stiffness[: planes.own // 2]
    assert (potential.normal_forces(x) > 0).sum() > 20

    def total(at: np.ndarray) -> float:
        # All that may get near: the same pairs in the same order.
        pairs = contact.proximity.near(at, SETTINGS.reach)
        chosen = {tuple(v): d for v, d in zip(pairs.vertices.tolist(), pairs.distances, strict=True)}
        distances = np.array([chosen[name] for name in names])
        return float(2 * keys @ PENALTY.value(0.5 * (SETTINGS.thickness - distances)))

    near = contact.proximity.near(x, 2 * SETTINGS.thickness)
    names = [tuple(v) for v in near.vertices.tolist()]
    assert len(names) == planes.own // 2
    generator = np.random.default_rng(4)
    for _ in range(5):
        direction = generator.normal(size=x.shape)
        expected = (total(x + 1e-8 * direction) - total(x - 1e-8 * direction)) / 2e-8
        assert float((potential.gradient(x) * direction).sum()) == pytest.approx(expected, rel=1e-5)


def test_the_hessian_is_that_of_automatic_differentiation() -> None:
    contact, x = crumpled()
    planes = contact.planes(x, x, x)
    potential = ContactPotential(planes, x, 0.0, PENALTY, 1e-4)
    vertices, weights = torch.from_numpy(planes.vertices), torch.from_numpy(planes.weights)
    normals, offsets, stiffness = (
        torch.from_numpy(a) for a in (planes.normals, planes.offsets, planes.stiffness)
    )

    def total(at: Tensor) -> Tensor:
        y = (weights[..., None] * at.reshape(-1, 3)[vertices]).sum(1)
        d = (offsets - (normals * y).sum(1)).clamp(min=0)
        w = PENALTY.smoothing
        soft = torch.where(d < w, d**3 / (6 * w), 0.5 * (d - w / 2) ** 2 + w**2 / 24)
        return (stiffness * (soft + d**4 / (4 * PENALTY.hardening**2))).sum()

    at = torch.from_numpy(x).reshape(-1)
    assert potential.total(x, np.ones(x.shape)) == pytest.approx(float(total(at)), rel=1e-12)
    expected = torch.autograd.functional.hessian(total, at).numpy()
    n = len(x)
    pattern = BlockPattern.of_pairs(n, np.array(list(combinations(range(n), 2))))
    blocks = np.zeros((len(pattern.rows), 3, 3))
    potential.add_hessian(blocks, pattern, x, convex=False)
    full = np.zeros((3 * n, 3 * n))
    for block, row, column in zip(blocks, pattern.rows, pattern.columns, strict=True):
        full[3 * row : 3 * row + 3, 3 * column : 3 * column + 3] = block
        full[3 * column : 3 * column + 3, 3 * row : 3 * row + 3] = block.T
    np.testing.assert_allclose(full, expected, rtol=0, atol=1e-9 * np.abs(expected).max())
    assert np.linalg.eigvalsh(full).min() > -1e-9 * np.abs(full).max()


def test_planes_couple_only_what_the_cloth_couples() -> None:
    contact, x = crumpled()
    _, faces = two_patches(0.0014)
    edges = Topology(len(x), faces).edges.numpy()
    pattern = BlockPattern.of_pairs(len(x), edges)
    blocks = np.zeros((len(pattern.rows), 3, 3))
    planes = contact.planes(x, x, x)
    ContactPotential(planes, x, 0.3, PENALTY, 1e-4).add_hessian(blocks, pattern, x, convex=False)
    assert np.abs(blocks).max() > 0.0


def test_two_patches_that_collide_go_on_together() -> None:
    """Planes follow from pass to pass only: a collision loses momentum, but little energy is left in it."""
    vertices, faces = two_patches(0.006)
    garment = free_garment(vertices + torch.tensor([0.0, 5.0, 0.0]), faces, friction=0.0)
    layer = SimulationLayer(garment, FLOOR_FACES, settings=LayerSettings(own_contact=SETTINGS))
    upper = len(vertices) // 2
    x, v, h = garment.rest_vertices, torch.zeros_like(vertices), 1 / 240
    v[upper:, 1] = -0.5
    for _ in range(6):
        step = layer.step(x, v, FLOOR, FLOOR, h)
        assert step.converged
        x, v = step.positions, step.velocities
    # Against what falls: a quarter of a metre a second if nothing were lost.
    speeds = [float(part[:, 1].mean()) + 6 * GRAVITY * h for part in (v[:upper], v[upper:])]
    assert speeds[0] == pytest.approx(speeds[1], abs=0.03)
    assert -0.25 < np.mean(speeds) < -0.17
    assert float(x[upper:, 1].mean() - x[:upper, 1].mean()) > 0.5 * SETTINGS.thickness


def test_a_folded_strip_lies_on_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    vertices, faces = folded(8, 4, 0.025)
    garment = free_garment(vertices, faces, bending=1e-6)
    results = {}
    for own in (None, SETTINGS):
        layer = SimulationLayer(garment, FLOOR_FACES, settings=LayerSettings(own_contact=own))
        motion = layer.simulate(FLOOR.expand(9, -1, -1), 30.0)
        results[own is None] = layer, motion.garment_positions, motion.converged.mean()
    topology = results[True][0].cloth.topology
    proximity = SelfProximity(
        len(vertices), faces.numpy(), topology.edges.numpy(), np.zeros(0, np.int64), SETTINGS.reach
    )
    crossings = {passing: [proximity.crossings(x) for x in found[1]] for passing, found in results.items()}
    assert max(crossings[True]) > 20
    assert max(crossings[False]) == 0
    assert results[False][2] > 0.9
    # Layers lie their thickness apart, where without contact both are on the floor.
    last, thickness = results[False][1][-1], SETTINGS.thickness
    assert last[-4:, 1].mean() - last[:4, 1].mean() == pytest.approx(thickness, rel=0.25)
    assert abs(results[True][1][-1][-4:, 1].mean() - results[True][1][-1][:4, 1].mean()) < 0.1 * thickness
    # Action and reaction: the floor bears all the weight, nothing is borne by the layers themselves.
    layer, x = results[False][0], torch.from_numpy(last)
    contacts = []
    begin = layer.contact.begin
    monkeypatch.setattr(layer.contact, "begin", lambda *given: contacts.append(begin(*given)) or contacts[-1])
    step = layer.step(x, torch.zeros_like(x), FLOOR, FLOOR, 1 / 120)
    planes = contacts[0].potential.planes
    pushes = contacts[0].potential.normal_forces(step.positions.numpy())
    assert planes.own > 10
    assert pushes[-planes.own :].sum() > 0.0
    of_floor = (pushes * planes.normals[:, 1])[: -planes.own].sum()
    assert of_floor == pytest.approx(GRAVITY * float(layer.cloth.masses.sum()), rel=0.05)


def test_a_garment_that_starts_through_itself_is_told() -> None:
    vertices, faces = two_patches(0.006)
    tilted = vertices + torch.tensor([0.0, 1.0, 0.0])
    tilted[16:, 1] = 1.0 + 0.5 * (tilted[16:, 0] - tilted[16:, 0].mean())
    layer = SimulationLayer(
        free_garment(tilted, faces), FLOOR_FACES, settings=LayerSettings(own_contact=SETTINGS)
    )
    with pytest.raises(InputError, match="Garment starts through itself"):
        layer.simulate(FLOOR.expand(2, -1, -1), 30.0)
