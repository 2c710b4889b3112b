"""Masses, rest lengths, stencils, units and states."""

import pytest
import torch

from toile.physics.cloth import (
    Cloth,
    grid_cloth,
    grid_masses,
    template_rest_lengths,
    uniform_rest_lengths,
)
from toile.physics.state import State
from toile.physics.stencils import Stencils, grid_stencils
from toile.physics.units import NetworkUnits


def flat(height, width, size):
    side_i = torch.linspace(0, size[0], height, dtype=torch.float64)
    side_j = torch.linspace(0, size[1], width, dtype=torch.float64)
    i, j = torch.meshgrid(side_i, side_j, indexing="ij")
    return torch.stack((j, i, torch.zeros_like(i)), -1).reshape(-1, 3)


def test_masses_add_up_to_the_sheet_and_weigh_by_cells():
    masses = grid_masses(7, 12, (0.6, 0.4), 0.25)
    assert masses.sum().item() == pytest.approx(0.25 * 0.6 * 0.4, rel=1e-14)
    grid = masses.reshape(7, 12) / masses.max()
    assert (grid[1:-1, 1:-1] == 1).all()
    assert (grid[0, 1:-1] == 0.5).all()
    assert (grid[1:-1, -1] == 0.5).all()
    assert grid[0, 0] == grid[-1, -1] == grid[0, -1] == grid[-1, 0] == 0.25


@pytest.mark.parametrize("grid", [(2, 2), (2, 5), (7, 3), (7, 12)])
def test_uniform_rest_lengths_are_those_of_a_flat_template(grid):
    size = (0.6, 0.35)
    stencils = grid_stencils(*grid)
    measured = template_rest_lengths(stencils, flat(*grid, size))
    torch.testing.assert_close(uniform_rest_lengths(stencils, grid, size), measured, rtol=0, atol=1e-15)


def test_grid_stencils_of_3x4_by_hand():
    stencils = grid_stencils(3, 4)
    assert len(stencils.edges) == 2 * 4 + 3 * 3
    assert len(stencils.corners) == 4 * 6
    assert len(stencils.straights) == 1 * 4 + 3 * 2
    edges = {tuple(e) for e in stencils.edges.tolist()}
    assert (0, 4) in edges
    assert (0, 1) in edges
    assert (3, 4) not in edges  # the end of a row and the start of the next
    assert [0, 4, 8] in stencils.straights.tolist()
    assert [1, 2, 3] in stencils.straights.tolist()
    # Four corners around the interior vertex 5, one at the corner vertex 0.
    around = stencils.corners[:, 1].bincount(minlength=12).tolist()
    assert around[5] == 4
    assert around[0] == 1
    assert around[1] == 2


def test_bad_sizes_are_told():
    with pytest.raises(ValueError, match=r"at least 2×2 vertices, got 1×5"):
        grid_stencils(1, 5)
    with pytest.raises(ValueError, match=r"pinned: expected vertex indices in \[0, 6\), got \[6\]"):
        grid_cloth((2, 3), (1.0, 1.0), 0.2, (6,))
    with pytest.raises(ValueError, match=r"edges: expected shape \(n, 2\), got \(1, 3\)"):
        Stencils(3, torch.zeros(1, 3).long(), torch.zeros(0, 3).long(), torch.zeros(0, 3).long())
    with pytest.raises(ValueError, match=r"corners: expected vertex indices in \[0, 3\), got \[0, 7\]"):
        Stencils(3, torch.zeros(0, 2).long(), torch.tensor([[0, 1, 7]]), torch.zeros(0, 3).long())
    cloth = grid_cloth((2, 3), (1.0, 1.0), 0.2, ())
    with pytest.raises(ValueError, match=r"masses: expected shape \(6,\), got \(5,\)"):
        Cloth(cloth.topology, cloth.energies, torch.ones(5), cloth.pinned)


def test_network_units_are_those_of_newtons_law():
    units = NetworkUnits(mass=2e-4, length=0.018, time=0.02)
    # One network unit of force moves the mass by one length per time² .
    assert units.force == pytest.approx(units.mass * units.length / units.time**2)
    assert units.stretching * units.length == pytest.approx(units.force)
    assert units.energy == pytest.approx(units.force * units.length)


def test_state_starts_on_a_straight_line():
    positions = torch.rand(2, 5, 3, dtype=torch.float64)
    velocities = torch.rand(2, 5, 3, dtype=torch.float64)
    state = State.start(positions, velocities, 0.1, 3)
    assert state.steps == 0
    for k in range(3):
        torch.testing.assert_close(state.past[:, k], positions - 0.1 * (k + 1) * velocities)
