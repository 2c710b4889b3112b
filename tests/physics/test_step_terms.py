"""Forces within a step, where the answer is known: drag, damping, contact, friction, shape and stiffness."""

import math
from itertools import pairwise

import numpy as np
import pytest
import torch

from toile.effects.air_drag import AirDrag
from toile.effects.anisotropic_stiffness import AnisotropicStiffness
from toile.effects.contact import Contact
from toile.effects.internal_damping import InternalDamping
from toile.effects.nonuniform_stiffness import NonuniformStiffness
from toile.effects.obstacles import Plane, Sphere, TriangleMesh
from toile.effects.rest_curvature import RestCurvature
from toile.effects.strain_stiffening import StrainStiffening
from toile.geometry.mesh import grid_faces, vertex_normals
from toile.physics.cloth import grid_cloth, grid_material
from toile.physics.hybrid.simulator import HybridSimulator
from toile.physics.implicit.assembly import Assembly
from toile.physics.implicit.integrators import BDF2, BackwardEuler
from toile.physics.implicit.linear_solvers.banded import BandedSolver
from toile.physics.implicit.newton import NewtonSettings, minimise_incremental_potential
from toile.physics.implicit.simulator import ImplicitSimulator
from toile.physics.implicit.terms import VertexPotential
from toile.physics.material import Material
from toile.physics.rollout import rollout
from toile.physics.simulator import StepStatus
from toile.physics.state import State
from toile.physics.step_terms import StepContext

TIGHT = NewtonSettings(tolerance=1e-11)
CLOSE = NewtonSettings(tolerance=1e-8)


def one(value):
    return torch.tensor([value], dtype=torch.float64)


MATERIAL = grid_material(one(80.0), one(3e-4), one(1e-5))


def vector(*values):
    return torch.tensor(values, dtype=torch.float64)


def flat(grid, size):
    """In the plane z = 1, whose normals point to -z or +z alike; (1, N, 3)."""
    i, j = torch.meshgrid(
        torch.linspace(0, size[0], grid[0], dtype=torch.float64),
        torch.linspace(0, size[1], grid[1], dtype=torch.float64),
        indexing="ij",
    )
    return torch.stack((j, i, torch.ones_like(i)), -1).reshape(1, -1, 3)


def move(cloth, x, v, h, n, acceleration, terms, integrator=None, material=MATERIAL, batch=1, newton=CLOSE):
    simulator = ImplicitSimulator(cloth, h, integrator or BackwardEuler(), newton, terms)
    forces = (cloth.masses[:, None] * acceleration).expand(batch, n, -1, 3)
    boundary = x[:, None, cloth.pinned].expand(-1, n + 1, -1, -1)
    state = State.start(x, v, h, simulator.n_past)
    return rollout(simulator, state, material, forces, boundary, 1).positions


def energy(cloth, x, v, material=MATERIAL):
    """Kinetic and elastic energy of one scene."""
    elastic = cloth.energies.energy(x, cloth.energies.coefficients(material.values[0]))
    return float(elastic + 0.5 * (cloth.masses[:, None] * v.square()).sum())


GRID, SIZE = (5, 6), (0.2, 0.25)
CLOTH = grid_cloth(GRID, SIZE, 0.2, ())


def test_speed_decays_under_linear_drag():
    """Backward Euler: v_n = v_0 / (1 + c h)^n for every vertex alike."""
    h, c, n = 0.01, 3.0, 20
    v = vector(0.4, -0.3, 0.2).expand(1, CLOTH.n_vertices, 3)
    x = move(CLOTH, flat(GRID, SIZE), v, h, n, vector(0, 0, 0), [AirDrag({"linear": c})])
    speeds = (x[:, 1:] - x[:, :-1]) / h
    exact = v[:, None] * (1 + c * h) ** -torch.arange(1, n + 1, dtype=torch.float64)[None, :, None, None]
    torch.testing.assert_close(speeds, exact, rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize(
    ("values", "across", "along"),
    [
        ({"linear": 4.0}, 9.81 / 4, 9.81 / 4),
        ({"normal": 8.0}, 9.81 / 8, math.inf),
        ({"quadratic": 5.0}, math.sqrt(9.81 / 5), math.inf),
    ],
)
def test_terminal_velocity(values, across, along):
    for axis, expected in ((2, across), (1, along)):
        g = vector(0, 0, 0)
        g[axis] = 9.81
        x = flat(GRID, SIZE)
        x = move(CLOTH, x, 0 * x, 0.02, 250, g, [AirDrag(values)], BDF2())
        speed = float((x[0, -1, :, axis] - x[0, -2, :, axis]).mean() / 0.02)
        if math.isinf(expected):
            assert speed == pytest.approx(9.81 * 249.5 * 0.02, rel=1e-2)  # edge on, nothing brakes it
        else:
            assert speed == pytest.approx(expected, rel=1e-6)


def test_breathing_square_is_a_damped_oscillator():
    """Four vertices, four edges: m ẍ = -2 Y (x + τ ẋ) for each vertex along each edge direction."""
    cloth = grid_cloth((2, 2), (0.1, 0.1), 0.2, ())
    y, m, tau = 80.0, float(cloth.masses[0]), 4e-4
    x = flat((2, 2), (0.1, 0.1))
    x = x - x.mean(1, keepdim=True)
    stretch, h, n = 1e-3, 2e-5, 700
    moved = x * (1 + stretch)
    motion = move(cloth, moved, 0 * x, h, n, vector(0, 0, 0), [InternalDamping({"in_plane": tau})], BDF2())
    strain = (motion[0, :, 1, 0] - motion[0, :, 0, 0]) / 0.1 - 1
    t = h * torch.arange(n + 1, dtype=torch.float64)
    omega2 = 2 * y / m
    rate = omega2 * tau / 2
    omega = math.sqrt(omega2 - rate**2)
    exact = stretch * torch.exp(-rate * t) * (torch.cos(omega * t) + rate / omega * torch.sin(omega * t))
    assert omega * t[-1] > 2 * math.pi
    assert (strain - exact).abs().max() <= 0.01 * stretch
    assert exact.abs()[-150:].max() <= 0.5 * stretch


@pytest.mark.parametrize("values", [{"in_plane": 0.02}, {"bending": 0.1}, {"in_plane": 0.1, "bending": 1.0}])
def test_energy_only_falls_with_damping(values):
    x = flat(GRID, SIZE)
    x = x + torch.stack((0 * x[..., 0], 0.02 * x[..., 0], 0.03 * torch.sin(20 * x[..., 1])), -1)
    h = 2e-3
    still = torch.zeros_like(x)
    final = []
    for terms in ([], [InternalDamping(values)]):
        motion = move(CLOTH, x, still, h, 60, vector(0, 0, 0), terms)
        energies = [energy(CLOTH, x[0], still[0])]
        for n in range(1, 61):
            energies.append(energy(CLOTH, motion[0, n], (motion[0, n] - motion[0, n - 1]) / h))
        assert all(b <= a * (1 + 1e-9) for a, b in pairwise(energies))
        final.append(energies[-1])
    # So much damping that the cloth creeps keeps its elastic energy for longer.
    assert (final[1] < 0.9 * final[0]) == (values.get("bending", 0.0) < 1.0)


def test_damping_leaves_momentum_and_rest_alone():
    terms = [InternalDamping({"in_plane": 0.1, "bending": 1.0})]
    x = flat(GRID, SIZE)
    v = vector(0.4, -0.3, 0.2).expand(1, CLOTH.n_vertices, 3)
    motion = move(CLOTH, x, v, 0.01, 10, vector(0, 0, 0), terms)
    torch.testing.assert_close(motion[:, -1], x + 0.1 * v, rtol=0, atol=1e-9)

    generator = torch.Generator().manual_seed(1)
    v = 0.5 * torch.randn(1, CLOTH.n_vertices, 3, generator=generator, dtype=torch.float64)
    motion = move(CLOTH, x, v, 0.01, 10, vector(0, 0, 0), terms)
    last = (motion[0, -1] - motion[0, -2]) / 0.01
    m = CLOTH.masses[:, None]
    torch.testing.assert_close((m * last).sum(0), (m * v[0]).sum(0), rtol=1e-7, atol=1e-11)
    # Angular momentum: backward Euler loses some of its own, at rest axes of the order of h.
    spin = torch.linalg.cross(motion[0, -1], m * last).sum(0)
    free = move(CLOTH, x, v, 0.01, 10, vector(0, 0, 0), [])
    free_spin = torch.linalg.cross(free[0, -1], m * (free[0, -1] - free[0, -2]) / 0.01).sum(0)
    assert (spin - free_spin).norm() <= 0.05 * free_spin.norm()


def test_damping_does_not_move_the_equilibrium():
    cloth = grid_cloth(GRID, SIZE, 0.2, (0, 5))
    x = flat(GRID, SIZE)
    g = vector(0.0, 9.81, 0.5)
    drag = AirDrag({"linear": 20.0})
    hung = move(cloth, x, 0 * x, 0.02, 400, g, [drag])[:, -1]
    again = move(cloth, hung, 0 * x, 0.02, 5, g, [InternalDamping({"in_plane": 0.05, "bending": 0.5})])
    assert (again[:, -1] - hung).abs().max() <= 1e-6


def bent(angle):
    """A cloth of constant angle between its edges along axis 1, (N, 3)."""
    turn = angle * (torch.arange(GRID[1] - 1, dtype=torch.float64) - (GRID[1] - 2) / 2)
    chord = SIZE[1] / (GRID[1] - 1) * torch.stack((turn.cos(), turn.sin()), -1)
    curve = torch.cat((torch.zeros(1, 2, dtype=torch.float64), chord.cumsum(0)))
    along = torch.linspace(0, SIZE[0], GRID[0], dtype=torch.float64)
    x = torch.stack(
        (curve[None, :, 0].expand(GRID), along[:, None].expand(GRID), 1 + curve[None, :, 1].expand(GRID)), -1
    )
    return x.reshape(-1, 3)


def damped_step(x, v, h, bending, guess):
    """Where one step ends from x and v, (N, 3), that begins its search at the best of guesses (..., N, 3)."""
    assembly = Assembly.of(CLOTH)
    material = grid_material(one(80.0), one(3e-4), one(1e-3))
    now = StepContext(CLOTH, material, x, v, h, h, x[:0])
    damping = InternalDamping({"bending": bending})
    assembly.set_elements(damping.elements(CLOTH.energies.elements(), now))
    inertia = CLOTH.masses.numpy() / h**2
    stiffness = CLOTH.energies.coefficients(material.values[0]).numpy()
    found = minimise_incremental_potential(
        assembly,
        BandedSolver(assembly.pattern, assembly.pinned),
        guess.reshape(-1, *x.shape).numpy(),
        (x + h * v).numpy(),
        np.zeros((0, 3)),
        np.zeros(x.shape),
        stiffness,
        inertia,
        1e-2,
        CLOSE,
        linearize=False,
    )
    assert found.status is StepStatus.CONVERGED
    return torch.from_numpy(found.positions)


def test_a_damped_bend_has_one_step_to_go_to():
    """From the other side, too: an angle alone does not say to which side it was bent."""
    x, other, h = bent(0.2), bent(-0.2), 0.1
    still = torch.zeros_like(x)
    own = damped_step(x, still, h, 1.0, x)
    torch.testing.assert_close(damped_step(x, still, h, 1.0, other), own, rtol=0, atol=1e-9)
    # Of the bend a step of a tenth of the relaxation time lets go of a tenth.
    assert (own - x).abs().max() <= 0.05 * (other - x).abs().max()


def test_a_guess_beyond_all_numbers_is_none():
    x, h = bent(0.2), 0.1
    still = torch.zeros_like(x)
    found = damped_step(x, still, h, 1.0, torch.stack((1e200 * x, x)))
    torch.testing.assert_close(found, damped_step(x, still, h, 1.0, x), rtol=0, atol=0)


@pytest.mark.parametrize("angle", [0.01, 0.3])
def test_a_bend_that_turns_as_a_whole_is_hardly_damped(angle):
    """Of second order in the turn of a step; the moment itself stays what it is."""
    x = bent(angle)
    x = x - (CLOTH.masses[:, None] * x).sum(0) / CLOTH.masses.sum()
    for axis in torch.eye(3, dtype=torch.float64):
        left = []
        for turn in (0.08, 0.04):
            h = turn / 4.0  # 4 rad/s
            v = torch.linalg.cross((4.0 * axis).expand_as(x), x)
            now = StepContext(CLOTH, MATERIAL, x, v, h, h, x[:0])
            skew = turn * torch.tensor(
                [[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]], dtype=torch.float64
            )
            y = (x @ torch.linalg.matrix_exp(skew).T).requires_grad_()
            elements = InternalDamping({"bending": 1.0}).elements(CLOTH.energies.elements(), now)
            k = CLOTH.energies.coefficients(MATERIAL.values[0])
            (damped,) = torch.autograd.grad(CLOTH.energies.energy(y, k, elements), y)
            (elastic,) = torch.autograd.grad(CLOTH.energies.energy(y, k), y)
            dashpot = elastic.norm() / h  # if it stood where it was, or held against all of the bend
            left.append(float((damped - elastic).norm() / dashpot))
        assert left[0] <= (0.1 if angle < 0.02 else 0.01), (axis, left)
        assert angle < 0.02 or left[1] <= 0.3 * left[0] or left[0] < 1e-6, (axis, left)


N_STRIP, STRIP = 13, 0.3
BENDING = 3e-4  # N·m


def settled_strip(axis, curvature):
    """Middle line (N_STRIP - 1, 3) of a strip clamped at one end, and which way its normal points."""
    grid, size = ((N_STRIP, 3), (STRIP, 0.05)) if axis == 0 else ((3, N_STRIP), (0.05, STRIP))
    index = torch.arange(3 * N_STRIP).reshape(grid)
    pinned = (index[:2] if axis == 0 else index[:, :2]).reshape(-1)
    cloth = grid_cloth(grid, size, 0.2, tuple(pinned.tolist()))
    material = grid_material(one(80.0), one(3e-4), one(BENDING))
    x = flat(grid, size)
    terms = [curvature, AirDrag({"linear": 4.0})]
    end = move(cloth, x, 0 * x, 0.02, 400, vector(0, 0, 0), terms, material=material)[0, -1]
    line = (end.reshape(*grid, 3)[:, 1] if axis == 0 else end.reshape(*grid, 3)[1]).diff(dim=0)
    return line, math.copysign(1.0, float(vertex_normals(x[0], grid_faces(*grid))[0, 2]))


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("axis", [0, 1])
def test_strip_settles_to_its_natural_curvature(axis, sign):
    """One end clamped, no gravity: an arc that turns by κ L per segment, towards the normal."""
    line, up = settled_strip(axis, RestCurvature({f"axis_{axis}": 8.0 * sign * BENDING}))
    direction = line / line.norm(dim=-1, keepdim=True)
    angles = torch.arccos((direction[1:] * direction[:-1]).sum(-1).clamp(max=1.0))
    segment = STRIP / (N_STRIP - 1)
    assert angles.tolist() == pytest.approx([8.0 * segment] * (N_STRIP - 2), rel=1e-3)
    assert math.copysign(1.0, float(line[-1, 2])) == sign * up


@pytest.mark.parametrize("axis", [0, 1])
def test_strip_settles_to_a_curvature_that_varies_along_it(axis):
    """At every vertex it turns by κ(u) L, κ(u) = 3 + 6 cos(2πu), of either sign."""
    fold = RestCurvature({f"axis_{axis}": 3.0 * BENDING, f"axis_{axis}_2": 6.0 * BENDING}, half_waves=2)
    line, up = settled_strip(axis, fold)
    heading = torch.atan2(line[:, 2], line[:, 1 - axis])
    u = torch.linspace(0, 1, N_STRIP, dtype=torch.float64)[1:-1]
    expected = (3.0 + 6.0 * torch.cos(2 * torch.pi * u)) * STRIP / (N_STRIP - 1)
    torch.testing.assert_close(up * heading.diff(), expected, rtol=0.02, atol=2e-4)


@pytest.mark.parametrize(
    "term",
    [
        AirDrag({"linear": 1.0, "normal": 2.0, "quadratic": 3.0}),
        RestCurvature({"axis_0": 5e-5, "axis_1_1": -3e-5}, half_waves=1),
    ],
)
def test_what_is_quadratic_is_expanded_without_error(term):
    """Potential, gradient and second derivatives away from the step's begin, against torch's own."""
    generator = torch.Generator().manual_seed(1)
    x, v, away = (torch.randn(3, CLOTH.n_vertices, 3, generator=generator) * 0.01).double()
    x = flat(GRID, SIZE)[0] + x
    now = StepContext(CLOTH, MATERIAL, x, v, 0.01, 0.01, x[:0])
    at = x + away
    assert term.quadratic
    potential = VertexPotential((term,), now)

    assert_as_torch_has_it(potential, (term,), now, at)


@pytest.mark.parametrize(
    "obstacle_at",
    [
        lambda c: Plane(c, (0.2, -0.1, 1.0)),
        lambda c: Sphere(c - c.new_tensor((0, 0, 0.3)), 0.295),
        lambda c: None,
    ],
)
@pytest.mark.parametrize("beside", [(), (AirDrag({"linear": 1.0}),)])
def test_contact_in_closed_form_is_that_of_torch(obstacle_at, beside):
    """With friction that sticks and that slides, alone and beside a term without a closed form."""
    generator = torch.Generator().manual_seed(2)
    x, v, away = (torch.randn(3, CLOTH.n_vertices, 3, generator=generator) * 0.01).double()
    x = flat(GRID, SIZE)[0] + x
    now = StepContext(CLOTH, MATERIAL, x, v, 0.01, 0.01, x[:0])
    # Some vertices have moved by less than friction sticks, 0.1 mm.
    away[::2] *= 0.005
    obstacle = obstacle_at(x.mean(0))
    term = Contact(obstacle, {"stiffness": 2e4, "friction": 0.4}, thickness=0.01)
    terms = (term, *beside)
    assert term.derivatives((x + away).numpy(), now) is not None
    if obstacle is not None:
        inside = term.depth(x, x) > 0
        assert not inside.all()
        assert inside[::2].any()
        assert inside[1::2].any()
    assert_as_torch_has_it(VertexPotential(terms, now), terms, now, x + away)


def test_contact_with_a_mesh_leaves_its_derivatives_to_torch():
    corners, faces = torch.eye(4, 3).double(), [[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]]
    mesh = TriangleMesh(corners, torch.tensor(faces))
    x = flat(GRID, SIZE)[0]
    now = StepContext(CLOTH, MATERIAL, x, 0 * x, 0.01, 0.01, x[:0])
    assert Contact(mesh, thickness=0.01).derivatives(x.numpy(), now) is None


def assert_as_torch_has_it(potential, terms, now, at):
    """Potential, gradient and second derivatives at positions."""

    def energies(y):
        return sum(term.energy(y, now) for term in terms)

    def total(y):
        return energies(y).sum()

    slope = torch.autograd.functional.jacobian(total, at)
    whole = torch.autograd.functional.hessian(total, at)
    i = torch.arange(len(at))
    for found, expected in (
        (potential.energy(at.numpy()), energies(at)),
        (potential.gradient(at.numpy()), slope),
        (potential.blocks(at.numpy(), convex=False), whole[i, :, i]),
    ):
        scale = float(expected.abs().max())
        torch.testing.assert_close(torch.from_numpy(found), expected, rtol=0, atol=1e-12 * scale + 1e-18)


def test_rest_curvature_pulls_without_net_force_or_torque():
    x = flat(GRID, SIZE)[0]
    x = x + torch.stack((0 * x[:, 0], 0 * x[:, 0], 0.03 * torch.sin(20 * x[:, 1] + 3 * x[:, 0])), -1)
    now = StepContext(CLOTH, MATERIAL, x, 0 * x, 0.01, 0.01, x[:0])
    term = RestCurvature({"axis_0": 5e-5, "axis_1": -3e-5})
    at = x.clone().requires_grad_()
    (forces,) = torch.autograd.grad(-term.energy(at, now).sum(), at)
    size = forces.norm(dim=-1).sum()
    assert size > 1e-3
    assert forces.sum(0).norm() <= 1e-12 * size
    # Exactly none where the cloth does not bend within its own plane.
    torques = torch.linalg.cross(x - x.mean(0), forces)
    assert torques.sum(0).norm() <= 1e-3 * torques.norm(dim=-1).sum()


def test_cloth_rests_on_a_plane_as_deep_as_the_penalty_says():
    x = flat(GRID, SIZE)
    plane = Plane((0.0, 0.0, 1.01), (0.0, 0.0, -1.0))
    terms = [Contact(plane, {"stiffness": 2e4}, thickness=2e-3), AirDrag({"linear": 10.0})]
    end = move(CLOTH, x, 0 * x, 0.01, 300, vector(0, 0, 9.81), terms)[0, -1]
    expected = 1.01 - 2e-3 + 9.81 / 2e4
    assert end[:, 2].tolist() == pytest.approx([expected] * CLOTH.n_vertices, abs=1e-8)


@pytest.mark.parametrize("friction", [0.0, 0.3, 0.8])
def test_cloth_on_a_slope_sticks_or_slides_as_coulomb_says(friction):
    """Plane at 30°: it slides with g (sin α - μ cos α), or creeps below the sticking speed if μ > tan α."""
    alpha, g, k = math.pi / 6, 9.81, 2e4
    x = flat(GRID, SIZE)
    plane = Plane((0.0, 0.0, 1.0), (0.0, 0.0, -1.0))
    pull = vector(0.0, g * math.sin(alpha), g * math.cos(alpha))
    # Where it would rest already.
    x = x + vector(0, 0, g * math.cos(alpha) / k)
    term = Contact(plane, {"stiffness": k, "friction": friction}, sticking_speed=0.002)
    motion = move(CLOTH, x, 0 * x, 0.01, 40, pull, [term])
    speed = float((motion[0, -1] - motion[0, -2])[:, 1].mean()) / 0.01
    slope = math.sin(alpha) - friction * math.cos(alpha)
    if slope > 0:
        assert speed == pytest.approx(g * slope * 0.4, rel=0.01)
    else:
        assert 0 < speed < 0.002


@pytest.mark.parametrize("axis", [0, 1])
def test_strip_under_tension_shows_anisotropy_and_stiffening(axis):
    """One side held, the opposite pulled: extension of every fibre by its own law."""
    h, w = GRID
    index = torch.arange(h * w).reshape(GRID)
    pinned, pulled = (index[0], index[-1]) if axis == 0 else (index[:, 0], index[:, -1])
    cloth = grid_cloth(GRID, SIZE, 0.2, tuple(pinned.tolist()))
    x = flat(GRID, SIZE)
    force = torch.zeros_like(x[0])
    pull = 0.3
    force[pulled, 1 - axis] = pull
    soft = grid_material(one(80.0), one(1e-12), one(1e-5))

    def strain(term):
        forces = force / cloth.masses[:, None]
        end = move(cloth, x, 0 * x, 0.02, 400, forces, [term, AirDrag({"linear": 20.0})], material=soft)
        span = end[0, -1, pulled[1], 1 - axis] - end[0, -1, pinned[1], 1 - axis]
        return float(span) / SIZE[axis] - 1

    n = GRID[axis] - 1
    rest = SIZE[axis] / n
    linear = pull / 80.0 / rest
    assert strain(AnisotropicStiffness({"stretching": 1.0})) == pytest.approx(
        linear * math.exp(0.5 if axis else -0.5), rel=1e-4
    )
    e = strain(StrainStiffening({"stretching": 400.0}))
    assert 80.0 * rest * e * (1 + 400.0 * e**2) == pytest.approx(pull, rel=1e-4)
    assert e < 0.8 * linear
    saturating = StrainStiffening().in_detail().with_values(torch.tensor([0.0, 0.0, 1.5, 0.0]).double())
    e, knee = strain(saturating), StrainStiffening.KNEES[0]
    assert 80.0 * rest * e * (1 + 1.5 * e**2 / (e**2 + knee**2)) == pytest.approx(pull, rel=1e-4)
    # Far beyond the knee it is a cloth that is stiffer by that factor.
    assert e > 10 * knee
    assert e == pytest.approx(linear / 2.5, rel=0.02)


@pytest.mark.parametrize("integrator", [BackwardEuler(), BDF2()], ids=["backward Euler", "BDF2"])
def test_gradients_by_all_inputs_with_terms(integrator):
    """Directional derivative through six steps against a central difference, all inputs at once."""
    cloth = grid_cloth(GRID, SIZE, 0.2, (0, 5))
    n, h = 6, 1 / 80
    terms = [
        AirDrag({"linear": 1.0, "normal": 3.0, "quadratic": 4.0}),
        InternalDamping({"in_plane": 0.01, "bending": 0.05}),
        StrainStiffening({"stretching": 500.0, "shearing": 10.0}),
        StrainStiffening().in_detail().with_values(torch.tensor([0.0, 0.0, 0.8, 0.5]).double()),
        NonuniformStiffness({"mode_10": 0.4, "mode_02": -0.3}),
        RestCurvature({"axis_0": 4e-5, "axis_1": -3e-5}),
        Contact(Plane((0.0, 0.0, 1.005), (0.1, 0.2, -1.0)), {"stiffness": 1e4, "friction": 0.4}),
    ]
    generator = torch.Generator().manual_seed(2)

    def random(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    x = flat(GRID, SIZE)
    x = x + torch.stack((0 * x[..., 0], 0 * x[..., 0], 0.01 * torch.sin(20 * x[..., 0] + 7 * x[..., 1])), -1)
    given = {
        "x": x,
        "v": 0.2 * random(1, 30, 3),
        "Y": one(60.0),
        "S": one(3e-4),
        "B": one(2e-5),
        "f": cloth.masses[:, None] * (vector(0.0, 9.81, 1.0) + random(1, n, 30, 3)),
        "a": x[:, None, cloth.pinned] + 0.002 * random(1, n + 1, 2, 3).cumsum(1),
    }
    scales = {"x": 1e-3, "v": 0.1, "Y": 60.0, "S": 3e-4, "B": 2e-5, "f": 1e-3, "a": 1e-3}
    along = {k: scales[k] * random(*v.shape) for k, v in given.items()}
    weights = random(1, n + 1, 30, 3)
    simulator = ImplicitSimulator(cloth, h, integrator, TIGHT, terms)

    def loss(at):
        state = State.start(at["x"], at["v"], h, simulator.n_past)
        motion = rollout(simulator, state, grid_material(at["Y"], at["S"], at["B"]), at["f"], at["a"], 1)
        return (weights * motion.positions).sum()

    leaves = {k: v.clone().requires_grad_() for k, v in given.items()}
    gradients = torch.autograd.grad(loss(leaves), tuple(leaves.values()))
    slopes = {k: float((g * along[k]).sum()) for k, g in zip(given, gradients, strict=True)}
    for name in given:
        ahead, behind = (float(loss({**given, name: given[name] + s * 1e-4 * along[name]})) for s in (1, -1))
        assert slopes[name] == pytest.approx((ahead - behind) / 2e-4, rel=1e-4, abs=1e-6), name


def test_batch_with_terms_is_its_scenes_one_by_one():
    terms = [AirDrag({"normal": 3.0}), InternalDamping({"in_plane": 0.01, "bending": 0.1})]
    generator = torch.Generator().manual_seed(3)
    x = flat(GRID, SIZE) + 0.002 * torch.randn(2, 30, 3, generator=generator, dtype=torch.float64)
    v = 0.2 * torch.randn(2, 30, 3, generator=generator, dtype=torch.float64)
    both = Material(MATERIAL.parameters, torch.cat((MATERIAL.values, 2 * MATERIAL.values)))

    def run(pick):
        material = Material(both.parameters, both.values[pick])
        given = x[pick].clone().requires_grad_()
        g = vector(0, 9.81, 0)
        motion = move(
            CLOTH, given, v[pick], 0.01, 5, g, terms, material=material, batch=len(given), newton=TIGHT
        )
        (gradient,) = torch.autograd.grad(motion[:, -1].square().sum(), given)
        return motion.detach(), gradient

    together = run(slice(None))
    for b in range(2):
        alone = run(slice(b, b + 1))
        for got, expected in zip(together, alone, strict=True):
            assert torch.equal(got[b : b + 1], expected)


def test_hybrid_simulator_takes_terms():
    terms = [AirDrag({"normal": 3.0}), InternalDamping({"in_plane": 0.01, "bending": 0.1})]
    cloth = grid_cloth(GRID, SIZE, 0.2, (0, 5))
    simulator = HybridSimulator(cloth, 0.01, BDF2(), None, 30, 1e-11, terms=terms)
    x = flat(GRID, SIZE)
    g = vector(0.0, 9.81, 3.0)
    state = State.start(x, 0 * x, 0.01, simulator.n_past)
    forces = (cloth.masses[:, None] * g).expand(1, 10, -1, 3)
    boundary = x[:, None, cloth.pinned].expand(-1, 11, -1, -1)
    hybrid = rollout(simulator, state, MATERIAL, forces, boundary, 1).positions
    implicit = move(cloth, x, 0 * x, 0.01, 10, g, terms, BDF2(), newton=TIGHT)
    assert (hybrid - implicit).abs().max() <= 1e-9
    plain = move(cloth, x, 0 * x, 0.01, 10, g, [], BDF2())
    assert (plain - implicit).abs().max() >= 1e-4
