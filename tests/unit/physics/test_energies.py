"""Energies: derivatives, invariances, analytic values and degenerate configurations, all in float64."""

import math

import pytest
import torch
from torch.autograd import gradcheck, gradgradcheck
from torch.autograd.functional import hessian

from toile.physics.energies.angle import angle_between, squared_angle
from toile.physics.energies.bending import bending_energy
from toile.physics.energies.external import external_potential
from toile.physics.energies.inertia import inertia_potential
from toile.physics.energies.shearing import shearing_energy
from toile.physics.energies.stretching import stretching_energy
from toile.physics.stencils import Stencils, grid_stencils

STEP = 0.02
REST = torch.tensor(STEP, dtype=torch.float64)


def flat(height, width, step=STEP):
    i, j = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    return step * torch.stack((j, i, torch.zeros_like(i)), -1).reshape(-1, 3).double()


def crumpled(height, width, seed=0, amount=0.3):
    noise = torch.randn(height * width, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return flat(height, width) + amount * STEP * noise


def random_motion(seed):
    generator = torch.Generator().manual_seed(seed)
    q, r = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64))
    rotation = q * torch.sign(torch.diagonal(r))
    rotation[:, 0] *= torch.sign(torch.det(rotation))
    return rotation, torch.randn(3, generator=generator, dtype=torch.float64)


def energies(stencils):
    """The three elastic energies as functions of positions, flat at rest with unit stiffness."""
    return {
        "stretching": lambda x: stretching_energy(x, stencils.edges, REST, 1.0),
        "shearing": lambda x: shearing_energy(x, stencils.corners, math.pi / 2, 1.0),
        "bending": lambda x: bending_energy(x, stencils.straights, 1.0),
    }


NAMES = ["stretching", "shearing", "bending"]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("seed", [0, 1])
def test_first_and_second_derivatives(name, seed):
    energy = energies(grid_stencils(3, 3))[name]
    x = crumpled(3, 3, seed) / STEP  # lengths of 1, so that gradcheck's absolute steps suit
    scaled = (lambda y: energy(STEP * y) / STEP**2) if name == "stretching" else energy
    x.requires_grad_()
    assert gradcheck(scaled, (x,), eps=1e-6, atol=1e-8, rtol=1e-6)
    assert gradgradcheck(scaled, (x,), eps=1e-6, atol=1e-7, rtol=1e-5)


@pytest.mark.parametrize("name", NAMES)
def test_derivative_with_respect_to_stiffness_is_the_unit_energy(name):
    x = crumpled(3, 4)
    stencils = grid_stencils(3, 4)
    k = torch.tensor(2.0, dtype=torch.float64, requires_grad=True)
    value = {
        "stretching": lambda: stretching_energy(x, stencils.edges, REST, k),
        "shearing": lambda: shearing_energy(x, stencils.corners, math.pi / 2, k),
        "bending": lambda: bending_energy(x, stencils.straights, k),
    }[name]()
    (slope,) = torch.autograd.grad(value, k)
    torch.testing.assert_close(slope, energies(stencils)[name](x).double(), rtol=1e-14, atol=0)


@pytest.mark.parametrize("name", NAMES)
def test_rest_is_a_minimum_with_finite_derivatives(name):
    """Exactly flat cloth: every straight angle is exactly zero, where a naive arccos has no derivative."""
    energy = energies(grid_stencils(4, 3))[name]
    x = flat(4, 3).requires_grad_()
    value = energy(x)
    (gradient,) = torch.autograd.grad(value, x)
    assert value.item() <= 1e-30
    assert gradient.abs().max() <= 1e-14
    h = hessian(energy, x.detach()).reshape(36, 36)
    assert torch.isfinite(h).all()
    eigenvalues = torch.linalg.eigvalsh(h)
    assert eigenvalues.min() >= -1e-12 * eigenvalues.max()  # worst seen 4e-16
    assert eigenvalues.max() > 0


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_rigid_motion_changes_nothing(name, seed):
    energy = energies(grid_stencils(4, 5))[name]
    rotation, shift = random_motion(seed)
    at_rest = energy(flat(4, 5) @ rotation.T + shift)
    scale = STEP**2 if name == "stretching" else 1.0
    assert at_rest.item() <= 1e-26 * scale  # worst seen 1e-27 (shearing)
    x = crumpled(4, 5, seed)
    torch.testing.assert_close(energy(x @ rotation.T + shift), energy(x), rtol=1e-12, atol=0)


@pytest.mark.parametrize("name", NAMES)
def test_internal_forces_have_no_resultant(name):
    """Forces and torques of an internal energy add up to zero."""
    x = crumpled(4, 5).requires_grad_()
    (gradient,) = torch.autograd.grad(energies(grid_stencils(4, 5))[name](x), x)
    scale = gradient.abs().sum().item()
    assert gradient.sum(0).abs().max() <= 1e-14 * scale
    assert torch.linalg.cross(x.detach(), gradient).sum(0).abs().max() <= 1e-14 * scale


@pytest.mark.parametrize("name", NAMES)
def test_vertex_and_element_order_do_not_matter(name):
    height, width = 4, 5
    generator = torch.Generator().manual_seed(3)
    order = torch.randperm(height * width, generator=generator)
    new_index = torch.empty_like(order)
    new_index[order] = torch.arange(height * width)
    s = grid_stencils(height, width)
    shuffled = Stencils(
        s.n_vertices,
        new_index[s.edges][torch.randperm(len(s.edges), generator=generator)].flip(1),
        new_index[s.corners][torch.randperm(len(s.corners), generator=generator)].flip(1),
        new_index[s.straights][torch.randperm(len(s.straights), generator=generator)].flip(1),
    )
    x = crumpled(height, width)
    torch.testing.assert_close(energies(shuffled)[name](x[order]), energies(s)[name](x), rtol=1e-13, atol=0)


def test_stencils_written_by_hand_give_the_same_energies():
    """Nothing but the stencils knows of the grid: index lists by loops, as for any other mesh."""
    height, width = 3, 4
    edges, corners, straights = [], [], []
    for i in range(height):
        for j in range(width):
            v = i * width + j
            down = [v + width] if i + 1 < height else []
            up = [v - width] if i > 0 else []
            right = [v + 1] if j + 1 < width else []
            left = [v - 1] if j > 0 else []
            edges += [(v, w) for w in down + right]
            corners += [(a, v, b) for a in up + down for b in left + right]
            straights += [(a, v, b) for a in up for b in down] + [(a, v, b) for a in left for b in right]
    by_hand = Stencils(height * width, *map(torch.tensor, (edges, corners, straights)))
    x = crumpled(height, width)
    for name in NAMES:
        torch.testing.assert_close(
            energies(by_hand)[name](x), energies(grid_stencils(height, width))[name](x), rtol=1e-13, atol=0
        )


@pytest.mark.parametrize("s", [0.5, 0.9, 1.1, 2.0])
def test_uniform_stretch_by_s(s):
    stencils = grid_stencils(4, 5)
    x = s * flat(4, 5)
    expected = 0.5 * 300.0 * len(stencils.edges) * ((s - 1) * STEP) ** 2
    got = stretching_energy(x, stencils.edges, REST, 300.0)
    assert got.item() == pytest.approx(expected, rel=1e-12)
    assert shearing_energy(x, stencils.corners, math.pi / 2, 1.0).item() <= 1e-28
    assert bending_energy(x, stencils.straights, 1.0).item() <= 1e-28


@pytest.mark.parametrize("gamma", [-0.7, 0.01, 0.3])
def test_pure_shear_by_gamma(gamma):
    """Trellis: edges keep their length, warp and weft enclose π/2 ± γ."""
    stencils = grid_stencils(4, 5)
    x = flat(4, 5)
    sheared = torch.stack((x[:, 0] + math.sin(gamma) * x[:, 1], math.cos(gamma) * x[:, 1], x[:, 2]), -1)
    expected = 0.5 * 1e-3 * len(stencils.corners) * gamma**2
    assert shearing_energy(sheared, stencils.corners, math.pi / 2, 1e-3).item() == pytest.approx(
        expected, rel=1e-12
    )
    assert stretching_energy(sheared, stencils.edges, REST, 1.0).item() <= 1e-30
    assert bending_energy(sheared, stencils.straights, 1.0).item() <= 1e-28


@pytest.mark.parametrize("theta", [1e-9, 1e-5, 0.0446, 0.0448, 0.3, 2.5])
def test_cylinder_of_constant_curvature(theta):
    """Edges of axis 1 are chords of a circle: all angles along it equal θ, all along the axis zero.

    0.0447 is where squared_angle passes from its series to arccos.
    """
    stencils = grid_stencils(3, 6)
    turn = theta * (torch.arange(6).double() - 0.5)
    chords = STEP * torch.stack((turn.cos(), turn.sin()), -1)
    curve = chords.cumsum(0)
    i, j = torch.meshgrid(torch.arange(3), torch.arange(6), indexing="ij")
    x = torch.stack((curve[j, 0], STEP * i.double(), curve[j, 1]), -1).reshape(-1, 3)
    expected = 0.5 * 1e-4 * 3 * 4 * theta**2
    assert bending_energy(x, stencils.straights, 1e-4).item() == pytest.approx(
        expected, rel=1e-12
    )  # worst seen 3e-14
    assert stretching_energy(x, stencils.edges, REST, 1.0).item() <= 1e-30
    assert shearing_energy(x, stencils.corners, math.pi / 2, 1.0).item() <= 1e-27


@pytest.mark.parametrize("u", [[1.0, 0, 0], [1e-3, 2e-3, -5e-3]])
@pytest.mark.parametrize("factor", [2.0, -0.5])
def test_parallel_edges_have_zero_not_nan_gradients(u, factor):
    u = torch.tensor(u, dtype=torch.float64, requires_grad=True)
    v = (factor * u.detach()).requires_grad_()
    angle = angle_between(u, v)
    assert angle.item() == (0.0 if factor > 0 else math.pi)
    squared = squared_angle(u, v)
    # arccos is clamped short of the fold: π - 1.4e-6
    assert squared.item() == pytest.approx(angle.item() ** 2, abs=1e-5)
    for gradient in (*torch.autograd.grad(angle, (u, v)), *torch.autograd.grad(squared, (u, v))):
        assert gradient.abs().max() <= 1e-13 / u.detach().norm()


@pytest.mark.parametrize("theta", [1e-7, 1e-3, 0.04471, 0.04473, 1.0, 3.0])
def test_squared_angle_and_angle_agree(theta):
    u = torch.tensor([0.3, 0.0, 0.0], dtype=torch.float64)
    v = torch.tensor([2 * math.cos(theta), 2 * math.sin(theta), 0.0], dtype=torch.float64, requires_grad=True)
    assert squared_angle(u, v).item() == pytest.approx(theta**2, rel=1e-8)
    (gradient,) = torch.autograd.grad(squared_angle(u, v), v)
    expected = 2 * theta / 2 * torch.tensor([-math.sin(theta), math.cos(theta), 0.0])
    torch.testing.assert_close(gradient, expected.double(), rtol=1e-6, atol=0)  # worst seen 8e-8, at 1e-7


def test_inertia_and_external_potential_are_newtons_second_law():
    """The minimiser of L_inert + L_ext over accelerations is a = F / m."""
    generator = torch.Generator().manual_seed(0)
    masses = torch.rand(5, generator=generator, dtype=torch.float64) + 0.1
    forces = torch.randn(2, 5, 3, generator=generator, dtype=torch.float64)
    accelerations = (forces / masses[:, None]).requires_grad_()
    total = inertia_potential(accelerations, masses, 0.02) + external_potential(accelerations, forces, 0.02)
    (gradient,) = torch.autograd.grad(total.sum(), accelerations)
    assert gradient.abs().max() <= 1e-17
    torch.testing.assert_close(total, -0.5 * 0.02**2 * (forces**2 / masses[:, None]).sum((-1, -2)))


def test_energies_keep_the_batch_dimensions():
    stencils = grid_stencils(3, 4)
    x = torch.stack([crumpled(3, 4, seed) for seed in range(6)]).reshape(2, 3, 12, 3)
    for energy in energies(stencils).values():
        one_by_one = torch.stack([energy(y) for y in x.reshape(6, 12, 3)]).reshape(2, 3)
        torch.testing.assert_close(energy(x), one_by_one, rtol=1e-14, atol=0)
    # one stiffness per scene
    k = torch.tensor([[1.0], [2.0]], dtype=torch.float64)
    x = x[:, 0]
    torch.testing.assert_close(
        bending_energy(x, stencils.straights, k), k[:, 0] * bending_energy(x, stencils.straights, 1.0)
    )
