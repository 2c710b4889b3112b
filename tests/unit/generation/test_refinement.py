"""A refined grid with converted stiffnesses is the same sheet."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from toile.errors import InputError
from toile.generation.refinement import coarsen, refine, refined_material, refined_size, refined_vertices
from toile.physics.cloth import grid_cloth, grid_masses, grid_material

SIZE = (0.6, 0.4)
GRID = (16, 12)
Y, S, B = 900.0, 0.005, 2e-4


def plane(grid: tuple[int, int]) -> Tensor:
    """Flat sheet (H, W, 3) [m]."""
    x, y = (torch.linspace(0, s, n, dtype=torch.float64) for s, n in zip(SIZE, grid, strict=True))
    i, j = torch.meshgrid(x, y, indexing="ij")
    return torch.stack((i, j, torch.zeros_like(i)), -1)


def sheared(flat: Tensor) -> Tensor:
    """Axis 1 turned by 0.1 rad without changing lengths."""
    x, y, z = flat.unbind(-1)
    return torch.stack((x + y * math.sin(0.1), y * math.cos(0.1), z), -1)


def rolled(flat: Tensor) -> Tensor:
    """Bent along axis 0 to a cylinder of radius 0.25 m."""
    x, y, _ = flat.unbind(-1)
    radius = 0.25
    return torch.stack((radius * torch.sin(x / radius), y, radius * (1 - torch.cos(x / radius))), -1)


def energies(positions: Tensor, factor: int) -> tuple[float, float, float]:
    """Stretching, shearing and bending energy [J] with the stiffnesses converted for a refinement factor."""
    grid = (positions.shape[0], positions.shape[1])
    cloth = grid_cloth(grid, SIZE, 0.15, ())
    values = (torch.tensor([v], dtype=torch.float64) for v in (Y, S, B))
    material = refined_material(grid_material(*values), factor)
    of = cloth.energies.each(positions.reshape(1, -1, 3), cloth.energies.coefficients(material.values))
    return float(of["stretching"]), float(of["shearing"]), float(of["bending"])


@pytest.mark.parametrize("factor", [2, 3])
def test_uniform_shear_has_the_same_energy_exactly(factor: int) -> None:
    coarse = energies(sheared(plane(GRID)), 1)
    fine = energies(sheared(plane(refined_size(GRID, factor))), factor)
    assert coarse[1] == pytest.approx(0.5 * S * 0.1**2 * 4 * 15 * 11, rel=1e-9)
    assert fine[1] == pytest.approx(coarse[1], rel=1e-9)


@pytest.mark.parametrize("factor", [2, 3])
def test_uniform_stretch_has_the_same_energy_up_to_the_border_lines(factor: int) -> None:
    strain = torch.tensor([1.01, 1.0, 1.0], dtype=torch.float64)
    W = GRID[1]
    fine_W = refined_size(GRID, factor)[1]
    coarse = energies(plane(GRID) * strain, 1)[0]
    fine = energies(plane(refined_size(GRID, factor)) * strain, factor)[0]
    # A sheet of W lines stands for W - 1 cells; nothing else differs.
    assert fine / (fine_W / (fine_W - 1)) == pytest.approx(coarse / (W / (W - 1)), rel=1e-9)
    assert fine == pytest.approx(coarse, rel=1 / (W - 1))


@pytest.mark.parametrize("factor", [2, 3])
def test_cylinder_has_the_same_bending_energy_up_to_the_border(factor: int) -> None:
    H, W = GRID
    h, w = refined_size(GRID, factor)
    coarse = energies(rolled(plane(GRID)), 1)[2]
    fine = energies(rolled(plane((h, w))), factor)[2]
    border = ((h - 2) * w / ((h - 1) * (w - 1))) / ((H - 2) * W / ((H - 1) * (W - 1)))
    assert fine == pytest.approx(coarse * border, rel=1e-3)
    assert border == pytest.approx(1, abs=0.02)


def test_the_energies_converge_to_those_of_the_continuous_sheet() -> None:
    """Cylinder: B / (2 L_i L_j) · L_i² κ² per area; shear: 4 S / (2 L_i L_j) γ² per area."""
    factor = 8
    cell = SIZE[0] * SIZE[1] / ((GRID[0] - 1) * (GRID[1] - 1))
    area = SIZE[0] * SIZE[1]
    spacing = SIZE[0] / (GRID[0] - 1)
    fine = energies(rolled(plane(refined_size(GRID, factor))), factor)
    assert fine[2] == pytest.approx(0.5 * B * (spacing / 0.25) ** 2 / cell * area, rel=0.01)


def test_the_mass_is_the_same() -> None:
    fine = grid_masses(*refined_size(GRID, 2), SIZE, 0.15)
    assert float(fine.sum()) == pytest.approx(0.15 * SIZE[0] * SIZE[1])


def test_refine_keeps_old_vertices_and_reproduces_cubics() -> None:
    flat = plane(GRID)
    curved = torch.stack((flat[..., 0], flat[..., 1], flat[..., 0] ** 3 - flat[..., 1] ** 2), -1)
    fine = refine(curved, 3)
    assert torch.equal(coarsen(fine, 3), curved)
    expected = plane(refined_size(GRID, 3))
    torch.testing.assert_close(fine[..., :2], expected[..., :2])
    torch.testing.assert_close(fine[..., 2], expected[..., 0] ** 3 - expected[..., 1] ** 2)


def test_refined_vertices_are_the_same_points() -> None:
    pinned = (0, 5, 15 * 12, 15 * 12 + 11)
    fine = refine(plane(GRID), 2).reshape(-1, 3)
    torch.testing.assert_close(
        fine[list(refined_vertices(pinned, GRID, 2))], plane(GRID).reshape(-1, 3)[list(pinned)]
    )


def test_factor_below_one_is_refused() -> None:
    with pytest.raises(InputError, match="Refinement factor"):
        refined_size(GRID, 0)
