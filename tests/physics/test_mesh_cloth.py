"""Cloth on triangle meshes against elasticity: uniform strain, hanging sheet, cantilever, grid."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from scipy.spatial import Delaunay
from torch import Tensor

from toile.geometry.mesh import grid_faces
from toile.physics.cloth import Cloth, grid_cloth, grid_material, mesh_cloth
from toile.physics.energies.membrane import Membrane, NeoHookean, StVenantKirchhoff
from toile.physics.implicit.integrators import BackwardEuler
from toile.physics.implicit.newton import NewtonSettings
from toile.physics.implicit.simulator import ImplicitSimulator
from toile.physics.material import Material
from toile.physics.rollout import rollout
from toile.physics.simulator import StepStatus
from toile.physics.state import State

G, DENSITY = 9.81, 0.2
MEMBRANES = pytest.mark.parametrize("membrane", [StVenantKirchhoff, NeoHookean])


def irregular(n: int, size: float, seed: int = 0) -> tuple[Tensor, Tensor]:
    """A square (N, 3) [m] of n vertices per side, those inside moved at random, and its triangles."""
    rng = np.random.default_rng(seed)
    points = np.stack(np.meshgrid(*2 * [np.linspace(0, size, n)], indexing="ij"), -1)
    points[1:-1, 1:-1] += rng.uniform(-0.35, 0.35, (n - 2, n - 2, 2)) * size / (n - 1)
    flat = points.reshape(-1, 2)
    faces = Delaunay(flat).simplices
    p = flat[faces]
    area = np.linalg.det(np.stack((p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), 1))
    faces = faces[np.abs(area) > 1e-9 * size**2]
    area = area[np.abs(area) > 1e-9 * size**2]
    faces[area < 0] = faces[area < 0][:, [0, 2, 1]]
    vertices = np.column_stack((flat, np.zeros(len(flat))))
    return torch.from_numpy(vertices), torch.from_numpy(faces.astype(np.int64))


def strip(n: int, cells: int, length: float) -> tuple[Tensor, Tensor]:
    """A strip along x of n cells, ``cells`` wide, in the x-y plane."""
    x, y = torch.meshgrid(
        torch.linspace(0, length, n + 1, dtype=torch.float64),
        torch.arange(cells + 1, dtype=torch.float64) * length / n,
        indexing="ij",
    )
    return torch.stack((x, y, torch.zeros_like(x)), -1).reshape(-1, 3), grid_faces(n + 1, cells + 1)


def forces_of(cloth: Cloth, material: Material, x: Tensor) -> Tensor:
    at = x.clone().requires_grad_()
    energy = cloth.energies.energy(at, cloth.energies.coefficients(material.values[0]))
    return -torch.autograd.grad(energy, at)[0]


def at_rest(cloth: Cloth, material: Material, x: Tensor, force: Tensor, steps: int, h: float = 0.3) -> Tensor:
    """Where the cloth comes to rest: backward Euler with steps so long that hardly any inertia is left."""
    simulator = ImplicitSimulator(cloth, h, BackwardEuler(), NewtonSettings(1e-7, max_iterations=200))
    state = State.start(x[None], torch.zeros_like(x)[None], h, simulator.n_past)
    for _ in range(steps):
        result = simulator.step(state, material, force[None], x[cloth.pinned][None])
        assert result.status == (StepStatus.CONVERGED,)
        # What is left of the motion is thrown away: only where it ends counts.
        found = result.state.positions
        moved = float((found - state.positions).abs().max())
        state = State.start(found, torch.zeros_like(found), h, simulator.n_past)
        if moved < 1e-9:
            break
    return state.positions[0]


def first_piola(membrane: type[Membrane], F: Tensor, young: float, poisson: float) -> Tensor:
    """Stress (3, 2) [N/m] of a uniform deformation gradient (3, 2), by the textbook."""
    lame, mu = young * poisson / (1 - poisson**2), young / (2 * (1 + poisson))
    C = F.T @ F
    one = torch.eye(2, dtype=torch.float64)
    if membrane is StVenantKirchhoff:
        E = (C - one) / 2
        return F @ (2 * mu * E + lame * torch.trace(E) * one)
    J = torch.linalg.det(C).sqrt()
    return mu * F + ((lame + mu) * (J - 1) - mu) * J * F @ torch.linalg.inv(C)


@MEMBRANES
def test_uniform_strain_gives_the_stress_exactly(membrane: type[Membrane]) -> None:
    """Patch test: no force inside, and on the border that of the stress, on any triangles."""
    x, faces = irregular(6, 0.4)
    young, poisson = 50.0, 0.3
    cloth = mesh_cloth(x, faces, DENSITY, (), membrane)
    material = cloth.material(young=young, poisson=poisson, bending=0.0)
    F = torch.tensor([[1.2, 0.15], [-0.05, 0.9], [0.3, 0.1]], dtype=torch.float64)
    force = forces_of(cloth, material, x[:, :2] @ F.T)
    # Traction on the border: P N times half of each of a vertex's two border edges.
    stress = first_piola(membrane, F, young, poisson)
    expected = torch.zeros_like(x)
    (loop,) = cloth.topology.boundary
    for a, b in zip(loop.tolist(), loop.roll(-1).tolist(), strict=True):
        edge = (x[b] - x[a])[:2]
        outward = torch.stack((edge[1], -edge[0]))
        if outward @ (x[a, :2] + x[b, :2] - 0.4) < 0:
            outward = -outward
        for vertex in (a, b):
            expected[vertex] -= 0.5 * stress @ outward
    assert float(expected.norm(dim=-1).max()) > 0.5
    torch.testing.assert_close(force, expected, rtol=0, atol=1e-12)


@MEMBRANES
def test_an_affine_border_makes_the_inside_affine(membrane: type[Membrane]) -> None:
    x, faces = irregular(7, 0.3, seed=1)
    border = tuple(mesh_cloth(x, faces, DENSITY, ()).topology.boundary[0].tolist())
    cloth = mesh_cloth(x, faces, DENSITY, border, membrane)
    material = cloth.material(young=80.0, poisson=0.25, bending=1e-4)
    F = torch.tensor([[1.1, 0.05], [0.02, 1.05], [0.0, 0.0]], dtype=torch.float64)
    affine = x[:, :2] @ F.T
    generator = torch.Generator().manual_seed(2)
    disturbed = affine.clone()
    inside = torch.ones(len(x), dtype=torch.bool)
    inside[list(border)] = False
    disturbed[inside] += 0.004 * torch.randn(int(inside.sum()), 3, generator=generator, dtype=torch.float64)
    found = at_rest(cloth, material, disturbed, torch.zeros_like(x), 12)
    assert float((found - affine).norm(dim=-1).max()) < 1e-7


@MEMBRANES
def test_small_strains_are_those_of_linear_elasticity(membrane: type[Membrane]) -> None:
    """Uniaxial tension with a free side: stress Y ε, and narrower by ν ε."""
    n, length, young, poisson = 8, 0.4, 50.0, 0.35
    x, faces = strip(n, 4, length)
    cloth = mesh_cloth(x, faces, DENSITY, (), membrane)
    pull = torch.zeros_like(x)
    strain = 1e-4
    left, right = x[:, 0] == 0, x[:, 0] > length - 1e-9
    width = float(x[:, 1].max())
    share = torch.ones(int(left.sum()), dtype=torch.float64)
    share[[0, -1]] = 0.5
    total = young * strain * width
    pull[right, 0], pull[left, 0] = total * share / share.sum(), -total * share / share.sum()
    found = at_rest(cloth, cloth.material(young=young, poisson=poisson, bending=1e-5), x, pull, 20)
    rows = found.reshape(n + 1, 5, 3)
    along = (rows[-1] - rows[0]).norm(dim=-1) / length - 1
    across = (rows[:, -1] - rows[:, 0]).norm(dim=-1) / width - 1
    torch.testing.assert_close(along, torch.full_like(along, strain), rtol=1e-3, atol=0)
    torch.testing.assert_close(across, torch.full_like(across, -poisson * strain), rtol=1e-3, atol=0)


@MEMBRANES
def test_a_hanging_sheet_stretches_as_a_rod_under_its_weight(membrane: type[Membrane]) -> None:
    """Pinned along the top, no lateral contraction: the lower side sinks by ρ g L² / (2 Y) at first order."""
    length, young = 0.5, 2000.0
    expected = DENSITY * G * length**2 / (2 * young)
    errors = []
    for n in (4, 8, 16):
        x, faces = strip(n, 3, length)
        pinned = tuple(torch.nonzero(x[:, 0] == 0).flatten().tolist())
        cloth = mesh_cloth(x, faces, DENSITY, pinned, membrane)
        weight = cloth.masses[:, None] * torch.tensor([G, 0.0, 0.0], dtype=torch.float64)
        found = at_rest(cloth, cloth.material(young=young, poisson=0.0, bending=1e-4), x, weight, 20)
        # Linear elements with lumped masses are exact at the vertices of a rod; what is left is second order.
        errors.append(abs(float(found[x[:, 0] > length - 1e-9, 0].mean()) - length - expected) / expected)
    assert max(errors) < 2e-3, errors


def test_a_cantilever_bends_by_its_rigidity_and_converges() -> None:
    """Clamped at one end, small load: the tip sinks by ρ g L⁴ / (8 D), closer with every refinement.

    Squares all cut the same way have hinges that see curvature and twist together: κ_xx + κ_xy along one
    side, κ_yy + κ_xy along the other, and κ_xy along the diagonal with four times the weight. A free strip
    twists by κ_xy = -κ_xx / 5, and its rigidity D is 0.8 B.
    """
    length, bending = 0.2, 1.0
    density = 8 * bending * 0.005 * length / (G * length**4)  # sinks by half a percent of its length
    errors = []
    for n in (10, 20, 40):
        x, faces = strip(n, 4, length)
        pinned = tuple(torch.nonzero(x[:, 0] <= length / n + 1e-9).flatten().tolist())
        cloth = mesh_cloth(x, faces, density, pinned, NeoHookean)
        weight = cloth.masses[:, None] * torch.tensor([0.0, 0.0, G], dtype=torch.float64)
        material = cloth.material(young=5e4, poisson=0.0, bending=bending)
        found = at_rest(cloth, material, x, weight, 60, h=1.0)
        # The hinge at the clamp stands for half a cell on each of its sides.
        free = length - 0.5 * length / n
        tip = float(found[x[:, 0] > length - 1e-9, 2].mean())
        errors.append(tip / (density * G * free**4 / (8 * 0.8 * bending)) - 1)
    assert abs(errors[2]) < 0.6 * abs(errors[1]) < 0.4 * abs(errors[0]), errors
    assert abs(errors[2]) < 0.025, errors
    # The clamp and the free sides leave an error of first order: what it tends to is the rigidity.
    assert abs(2 * errors[2] - errors[1]) < 0.005, errors


@MEMBRANES
def test_rigid_motions_are_free_of_force(membrane: type[Membrane]) -> None:
    x, faces = irregular(5, 0.3, seed=3)
    curved = torch.stack((x[:, 0], x[:, 1], 0.3 * x[:, 0] ** 2), -1)
    for flat, rest in ((True, x), (False, curved)):
        cloth = mesh_cloth(rest, faces, DENSITY, (), membrane, flat=flat)
        material = cloth.material(young=60.0, poisson=0.3, bending=1e-3)
        Q = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(4)).double())[0]
        Q = Q * torch.linalg.det(Q)
        moved = rest @ Q.T + torch.tensor([0.3, -1.0, 2.0], dtype=torch.float64)
        assert float(forces_of(cloth, material, moved).abs().max()) < 1e-11
        # A curved sheet that wants to be flat is not at rest.
    bent = mesh_cloth(curved, faces, DENSITY, (), membrane, flat=True)
    assert float(forces_of(bent, material, curved).abs().max()) > 1e-4


def test_a_hung_sheet_hangs_like_the_grids() -> None:
    """Pinned along the top, swung sideways: triangles agree with warp and weft, better if finer."""
    size, young, bending = 0.4, 400.0, 5e-5
    away = []
    for n in (9, 17):
        h = size / (n - 1)
        pinned = tuple(range(n))
        grid = grid_cloth((n, n), (size, size), DENSITY, pinned)
        i, j = torch.meshgrid(*2 * [torch.linspace(0, size, n, dtype=torch.float64)], indexing="ij")
        flat = torch.stack((j, i, torch.zeros_like(i)), -1).reshape(-1, 3)
        mesh = mesh_cloth(flat, grid.topology.faces, DENSITY, pinned, StVenantKirchhoff)
        pull = G * torch.tensor([0.3, 1.0, 0.3], dtype=torch.float64)
        # No lateral contraction; four corners of a cell share its shearing: μ = 4 S / h² = Y / 2.
        of_grid = grid_material(young, young * h**2 / 8, bending)
        of_mesh = mesh.material(young=young, poisson=0.0, bending=bending)
        found = [
            moved(cloth, material, flat, cloth.masses[:, None] * pull)
            for cloth, material in ((grid, of_grid), (mesh, of_mesh))
        ]
        assert float((found[0] - flat).norm(dim=-1).mean()) > 0.05 * size
        away.append(float((found[0] - found[1]).norm(dim=-1).mean()) / size)
    assert away[1] < 0.002, away
    assert away[1] < 0.6 * away[0], away


def moved(cloth: Cloth, material: Material, x: Tensor, force: Tensor) -> Tensor:
    """Where the cloth is after a second of strongly damped motion."""
    h, n = 0.02, 50
    simulator = ImplicitSimulator(cloth, h, BackwardEuler(), NewtonSettings(1e-6, max_iterations=300))
    state = State.start(x[None], torch.zeros_like(x)[None], h, simulator.n_past)
    boundary = x[cloth.pinned].expand(1, n + 1, -1, -1)
    return rollout(simulator, state, material, force.expand(1, n, -1, 3), boundary, 1).positions[0, -1]


@MEMBRANES
def test_gradients_of_a_motion_by_all_parameters(membrane: type[Membrane]) -> None:
    """Young's modulus, Poisson's ratio and bending of a swinging irregular sheet, against differences."""
    x, faces = irregular(5, 0.2, seed=5)
    cloth = mesh_cloth(x, faces, DENSITY, (0, 4), membrane)
    weight = cloth.masses[:, None] * torch.tensor([2.0, 0.0, G], dtype=torch.float64)
    simulator = ImplicitSimulator(cloth, 0.02, BackwardEuler(), NewtonSettings(1e-11))
    goal = torch.randn(x.shape, generator=torch.Generator().manual_seed(6), dtype=torch.float64)

    def loss(values: Tensor) -> Tensor:
        state = State.start(x[None], torch.zeros_like(x)[None], 0.02, simulator.n_past)
        boundary = x[cloth.pinned].expand(1, 7, -1, -1)
        material = Material(cloth.energies.parameters, values[None])
        motion = rollout(simulator, state, material, weight.expand(1, 6, -1, 3), boundary, 1)
        return (motion.positions[0, -1] * goal).sum()

    values = torch.tensor([30.0, 0.3, 2e-4], dtype=torch.float64)
    (gradient,) = torch.autograd.grad(loss(values.requires_grad_()), values)
    check_by_differences(loss, values.detach(), gradient)


def check_by_differences(loss: Callable[[Tensor], Tensor], values: Tensor, gradient: Tensor) -> None:
    for k in range(len(values)):
        step = torch.zeros_like(values)
        step[k] = 1e-4 * values[k]
        with torch.no_grad():
            slope = (loss(values + step) - loss(values - step)) / (2 * step[k])
        assert float(gradient[k]) == pytest.approx(float(slope), rel=1e-4)
