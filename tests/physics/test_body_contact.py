"""Contact with a body of triangles against mechanics: Coulomb's law, moving limbs, both sides."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
import trimesh
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from torch import Tensor

from toile.geometry.mesh import grid_faces
from toile.geometry.moving_surface import MovingSurface
from toile.physics.cloth import Cloth, mesh_cloth
from toile.physics.contact.body import BodyContact, ContactSettings
from toile.physics.implicit.integrators import BackwardEuler
from toile.physics.implicit.newton import NewtonSettings
from toile.physics.implicit.renewed import RenewingSimulator
from toile.physics.simulator import StepStatus
from toile.physics.state import State

Array = NDArray[np.float64]

G = 9.81
H = 1 / 240
SETTINGS = ContactSettings()


def rest_depth(pressure: float) -> float:
    """Depth at which the contact bears this force per mass [m/s²], where its force rises as a parabola."""
    return float(np.sqrt(2 * SETTINGS.smoothing * pressure / SETTINGS.stiffness))


def patch(size: float, n: int = 3) -> tuple[Tensor, Tensor]:
    """A flat square in the x-z plane, its faces turned up."""
    at = torch.linspace(-size / 2, size / 2, n, dtype=torch.float64)
    z, x = torch.meshgrid(at, at, indexing="ij")
    return torch.stack((x, torch.zeros_like(x), z), -1).reshape(-1, 3), grid_faces(n, n)


def slide(
    cloth: Cloth,
    start: Tensor,
    body: Callable[[int], Array],
    faces: NDArray[np.int64],
    friction: float,
    steps: int,
    gravity: Tensor,
    settings: ContactSettings = SETTINGS,
) -> Array:
    """Positions (steps + 1, N, 3) of a free cloth on a body whose vertices are given for every step."""
    contact = BodyContact(
        cloth.topology,
        cloth.masses.numpy(),
        np.zeros(0, np.int64),
        faces,
        np.zeros(len(body(0)), np.bool_),
        settings,
    )
    simulator = RenewingSimulator(cloth, H, BackwardEuler(), NewtonSettings(1e-6), passes=3)
    state = State.start(start[None], torch.zeros_like(start)[None], H, simulator.n_past)
    forces = cloth.masses[:, None] * gravity
    material = cloth.material(young=200.0, poisson=0.3, bending=1e-3)
    found = [start.numpy()]
    before = body(0)
    for n in range(1, steps + 1):
        after = body(n)
        step = contact.begin(state.positions[0].numpy(), before, after, friction, H)
        guess = step.outside((state.positions + H * state.velocities)[0].numpy())
        result = simulator.step_with(
            [step],
            state,
            material,
            forces[None],
            torch.zeros(1, 0, 3, dtype=torch.float64),
            torch.from_numpy(guess)[None],
        )
        assert result.status == (StepStatus.CONVERGED,)
        state, before = result.state, after
        found.append(state.positions[0].numpy())
    return np.stack(found)


GROUND = np.array([[-9.0, 0, -9], [-9, 0, 9], [9, 0, 9], [9, 0, -9]])
GROUND_FACES = np.array([[0, 1, 2], [0, 2, 3]])


@pytest.mark.parametrize(("friction", "degrees"), [(0.0, 10), (0.3, 10), (0.3, 25), (1.0, 35), (1.0, 55)])
def test_an_inclined_plane_obeys_coulombs_law(friction: float, degrees: float) -> None:
    """Slides with g (sin θ - μ cos θ) where tan θ > μ; else it sticks, up to the speed of sticking."""
    angle = np.deg2rad(degrees)
    x, faces = patch(0.1)
    cloth = mesh_cloth(x, faces, 0.2, ())
    height = SETTINGS.thickness - rest_depth(G * np.cos(angle))
    # The plane lies still and gravity leans.
    gravity = torch.tensor([G * np.sin(angle), -G * np.cos(angle), 0.0], dtype=torch.float64)
    steps = 60
    found = slide(
        cloth, x + torch.tensor([0.0, height, 0.0]), lambda n: GROUND, GROUND_FACES, friction, steps, gravity
    )
    travelled = (found - found[0])[..., 0].mean(1)
    pull = np.tan(angle) / friction if friction > 0 else np.inf
    if pull > 1:
        acceleration = G * (np.sin(angle) - friction * np.cos(angle))
        n = np.arange(steps + 1)
        expected = 0.5 * acceleration * H**2 * n * (n + 1)
        # It begins to slide within the speed of sticking.
        slack = SETTINGS.sticking_speed * n * H
        assert np.all(np.abs(travelled - expected) <= 2e-3 * expected + slack)
        assert travelled[-1] == pytest.approx(expected[-1], rel=0.03)
    else:
        creep = SETTINGS.sticking_speed * (1 - np.sqrt(1 - pull))
        speed = np.diff(travelled) / H
        np.testing.assert_allclose(speed[30:], creep, rtol=5e-3)
    assert np.abs(found[..., 1] - found[0, :, 1]).max() < 2e-5


@pytest.mark.parametrize("friction", [0.0, 0.3, 1.0])
def test_a_sphere_obeys_coulombs_law(friction: float) -> None:
    """Down a fine sphere: R θ'' = g sin θ - μ (g cos θ - R θ'²), or at rest below the angle of friction."""
    radius, first = 0.5, np.deg2rad(35.0)
    mesh = trimesh.creation.icosphere(6, radius)
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces, np.int64)
    x, patch_faces = patch(0.01, 2)
    cloth = mesh_cloth(x, patch_faces, 0.2, ())
    lift = radius + SETTINGS.thickness - rest_depth(G * np.cos(first))
    down = torch.tensor(
        [[np.cos(first), np.sin(first), 0], [-np.sin(first), np.cos(first), 0], [0, 0, 1]],
        dtype=torch.float64,
    )
    start = (x + torch.tensor([0.0, lift, 0.0])) @ down.T
    steps = 50
    gravity = torch.tensor([0.0, -G, 0.0], dtype=torch.float64)
    found = slide(cloth, start, lambda n: vertices, faces, friction, steps, gravity)
    centre = found.mean(1)
    angles = np.arctan2(centre[:, 0], centre[:, 1])
    around = np.linalg.norm(centre[0])
    if np.tan(first) < friction:
        assert (angles[-1] - angles[0]) * around < SETTINGS.sticking_speed * steps * H
        return

    def motion(_: float, y: Array) -> Array:
        turn = G * np.sin(y[0]) - friction * (G * np.cos(y[0]) - around * y[1] ** 2)
        return np.array([y[1], turn / around])

    times = H * np.arange(steps + 1)
    exact = solve_ivp(motion, (0, times[-1]), [angles[0], 0.0], t_eval=times, rtol=1e-9).y[0]
    assert angles[-1] - angles[0] > 0.1
    # Implicit Euler is late or early by about half a step; facets cost some speed.
    assert angles[-1] - angles[0] == pytest.approx(exact[-1] - exact[0], rel=0.05)
    heights = np.linalg.norm(found, axis=-1)
    assert heights.min() > radius + 0.5 * SETTINGS.thickness
    assert heights.max() < radius + 1.2 * SETTINGS.thickness


def test_friction_carries_a_cloth_along_with_the_body() -> None:
    """A plate that moves sideways takes a sticking cloth with it, and leaves one without friction behind."""
    x, faces = patch(0.1)
    cloth = mesh_cloth(x, faces, 0.2, ())
    start = x + torch.tensor([0.0, SETTINGS.thickness - rest_depth(G), 0.0])
    gravity = torch.tensor([0.0, -G, 0.0], dtype=torch.float64)

    def plate(n: int) -> Array:
        # Accelerates with 1 m/s², a third of what friction of 0.3 bears.
        return GROUND + np.array([0.5 * (n * H) ** 2, 0.0, 0.0])

    steps = 48
    travelled = plate(steps)[0, 0] - GROUND[0, 0]
    carried = slide(cloth, start, plate, GROUND_FACES, 0.3, steps, gravity)
    assert float((carried[-1] - carried[0])[:, 0].mean()) == pytest.approx(travelled, rel=0.05)
    left = slide(cloth, start, plate, GROUND_FACES, 0.0, steps, gravity)
    assert abs(float((left[-1] - left[0])[:, 0].mean())) < 1e-9


def test_a_thin_spike_does_not_pass_between_the_vertices() -> None:
    """A needle pushed up from below lifts a coarse cloth by its face: no vertex of the cloth is near it."""
    x, faces = patch(0.3)
    cloth = mesh_cloth(x, faces, 0.2, ())
    spike = trimesh.creation.icosphere(2, 0.02)
    ball, ball_faces = np.array(spike.vertices), np.array(spike.faces, np.int64)
    # Below the middle of a face.
    ball = ball + np.array([0.05, -0.024, 0.1])

    def push(n: int) -> Array:
        return ball + np.array([0.0, 0.5 * n * H, 0.0])

    steps = 40
    none = torch.zeros(3, dtype=torch.float64)
    found = slide(cloth, x, push, ball_faces, 0.3, steps, none)
    top = push(steps)[:, 1].max()
    assert top > 0.07
    surface = MovingSurface(len(x), faces.numpy())
    surface.move(found[-1])
    tip = np.array([[0.05, top, 0.1]])
    (below,) = surface.hits(tip - np.array([0.0, 1.0, 0.0]), np.array([[0.0, 1.0, 0.0]]), 2.0)
    assert below - 1.0 > -1e-4
    assert np.linalg.norm(found[-1] - np.array([0.05, top, 0.1]), axis=1).min() > 0.05


def test_a_fast_limb_does_not_jump_through() -> None:
    """A thin plate that moves by ten of its thicknesses within a step takes the cloth along."""
    x, faces = patch(0.1)
    cloth = mesh_cloth(x, faces, 0.2, ())
    box = trimesh.creation.box((0.4, 0.004, 0.4))
    box = box.subdivide().subdivide()
    plate, plate_faces = np.array(box.vertices), np.array(box.faces, np.int64)
    plate = plate - np.array([0.0, 0.002 + SETTINGS.thickness, 0.0])

    def rise(n: int) -> Array:
        return plate + np.array([0.0, 0.04 * n, 0.0])

    found = slide(cloth, x, rise, plate_faces, 0.3, 5, torch.zeros(3, dtype=torch.float64))
    for n in range(6):
        # It gives way by the impulse over the stiffness, and stays on its side.
        assert found[n][:, 1].min() > rise(n)[:, 1].mean()
