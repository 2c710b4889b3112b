"""Uneven grids are the same sheet as even ones: mass, threads, shear and bending."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from toile.physics.cloth import Cloth, grid_cloth
from toile.physics.grid_laws import angles, taut
from toile.physics.grid_lines import GridLines
from toile.physics.implicit.assembly import Assembly

SIZE = (0.5, 0.4)
GRID = (15, 12)
VALUES = {"stretching": 80.0, "shearing": 0.02, "bending": 3e-4}


def sheet(lines: GridLines) -> Tensor:
    """A flat sheet (H, W, 3) [m]."""
    u, v = (p * side for p, side in zip(lines.places(), SIZE, strict=True))
    x = torch.stack(torch.meshgrid(u, v, indexing="ij"), -1)
    return torch.cat((x, torch.zeros_like(x[..., :1])), -1)


def cloth_on(lines: GridLines, law=taut, **more) -> Cloth:
    return grid_cloth(lines.grid, SIZE, 0.2, (0,), law=law, lines=lines, **more)


def energies_of(cloth: Cloth, x: Tensor, **other: float) -> dict[str, float]:
    material = cloth.material(**{**VALUES, **other})
    coefficients = cloth.energies.coefficients(material.values[0])
    each = cloth.energies.each(x.reshape(-1, 3), coefficients)
    return {name: float(energy) for name, energy in each.items()}


def test_even_lines_change_nothing() -> None:
    plain, even = grid_cloth(GRID, SIZE, 0.2, (0,), law=taut), cloth_on(GridLines.even(*GRID))
    assert even.uneven is None
    assert torch.equal(plain.masses, even.masses)
    assert torch.equal(plain.rest_lengths, even.rest_lengths)
    for factors in even.energies.elements().factors.values():
        assert bool((factors == 1).all())
    for factors in GridLines.even(*GRID).element_factors().values():
        torch.testing.assert_close(factors, torch.ones_like(factors))


def test_lines_come_closer_towards_the_borders() -> None:
    lines = GridLines.crowded(401, 401, 0.5)
    first, _ = lines.spacings()
    assert float(first[0]) == pytest.approx(0.5, abs=0.01)
    assert float(first[200]) == pytest.approx(1 + 0.5 * (math.pi / 2 - 1), abs=0.01)
    assert bool((first[:200].diff() > 0).all())
    torch.testing.assert_close(first, first.flip(0))


@pytest.mark.parametrize("law", [angles, taut])
def test_a_crowded_sheet_resists_as_an_even_one(law) -> None:
    whole = {"edge_compression": 1.0, "diagonal_compression": 1.0} if law is taut else {}
    shear = torch.tensor([[1.0, 0.002, 0], [0, 1, 0], [0, 0, 1]], dtype=torch.float64)
    stretch = torch.diag(torch.tensor([1.003, 1.0, 1.0], dtype=torch.float64))
    found = {}
    for lines in (GridLines.even(*GRID), GridLines.crowded(*GRID, 0.6)):
        cloth = cloth_on(lines, law)
        assert float(cloth.masses.sum()) == pytest.approx(0.2 * SIZE[0] * SIZE[1])
        sheared = energies_of(cloth, sheet(lines) @ shear, **whole)["shearing"]
        found[lines] = sheared, energies_of(cloth, sheet(lines) @ stretch, **whole)["stretching"]
    even, crowded = found.values()
    # Both diagonals of a cell change by as much, but not by the same where the cell is no square.
    assert crowded[0] == pytest.approx(even[0], rel=0.01)
    # A line on a border stands for a whole strip, which is narrower here.
    assert 0.93 < crowded[1] / even[1] < 1


def test_rolled_up_it_has_the_same_bending_energy() -> None:
    found = []
    for lines in (GridLines.even(40, 40), GridLines.crowded(40, 40, 0.6)):
        flat = sheet(lines)
        k = 4.0
        rolled = torch.stack(
            (torch.sin(k * flat[..., 0]) / k, flat[..., 1], torch.cos(k * flat[..., 0]) / k), -1
        )
        found.append(energies_of(cloth_on(lines), rolled)["bending"])
    assert found[1] == pytest.approx(found[0], rel=0.03)


def test_masses_are_those_of_the_cells() -> None:
    lines = GridLines((0.0, 0.2, 1.0), (0.0, 0.5, 1.0))
    masses = cloth_on(lines).masses.reshape(3, 3) / (0.2 * SIZE[0] * SIZE[1])
    expected = torch.tensor([0.1, 0.5, 0.4], dtype=torch.float64)[:, None] * torch.tensor([0.25, 0.5, 0.25])
    torch.testing.assert_close(masses, expected)


def test_kernels_know_of_the_factors() -> None:
    lines = GridLines.crowded(7, 6, 0.5)
    generator = torch.Generator().manual_seed(0)
    x = sheet(lines).reshape(-1, 3)
    x = x + 0.01 * torch.randn(x.shape, generator=generator, dtype=torch.float64)
    cloth = cloth_on(lines)
    coefficients = cloth.energies.coefficients(cloth.material(**VALUES).values[0])
    leaf = x.clone().requires_grad_()
    (expected,) = torch.autograd.grad(cloth.energies.energy(leaf, coefficients), leaf)
    gradients = torch.from_numpy(Assembly.of(cloth).gradients(x.numpy()))
    found = (coefficients[:, None, None] * gradients).sum(0)
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("places", [(0.0, 0.5), (0.0, 0.6, 0.4, 1.0), (0.1, 1.0), (0.0,)])
def test_lines_that_do_not_rise_from_0_to_1_are_refused(places) -> None:
    with pytest.raises(ValueError, match="along_0"):
        GridLines(places, (0.0, 1.0))


def test_lines_of_another_grid_are_refused() -> None:
    for crowding in (0.0, 0.5):
        with pytest.raises(ValueError, match=r"\(7, 6\)"):
            grid_cloth((6, 7), SIZE, 0.2, (0,), lines=GridLines.crowded(7, 6, crowding))
