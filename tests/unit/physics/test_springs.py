"""Springs with compression ratios, and the taut law of a grid."""

import numpy as np
import pytest
import torch
from torch.autograd.functional import hessian, jacobian

from toile.physics.cloth import grid_cloth
from toile.physics.energies.springs import DiagonalShearing, TautStretching
from toile.physics.energies.stretching import Stretching
from toile.physics.energies.term import InternalEnergy
from toile.physics.grid_laws import angles, grid_diagonals, rest_diagonals, taut
from toile.physics.implicit.assembly import Assembly
from toile.physics.stencils import grid_stencils

GRID = (3, 4)
STEP = 0.02


def sheet(stretch=(1.0, 1.0), shear=0.0, noise=0.0):
    i, j = torch.meshgrid(torch.arange(3.0).double(), torch.arange(4.0).double(), indexing="ij")
    x = torch.stack((stretch[1] * j + shear * i, stretch[0] * i, torch.zeros_like(i)), -1).reshape(-1, 3)
    generator = torch.Generator().manual_seed(5)
    return STEP * (x + noise * torch.randn(12, 3, generator=generator, dtype=torch.float64))


def terms():
    edges = grid_stencils(*GRID).edges
    lengths = torch.full((len(edges),), STEP, dtype=torch.float64)
    return {
        "stretching": TautStretching(edges, lengths),
        "shearing": DiagonalShearing(grid_diagonals(*GRID), rest_diagonals(GRID, lengths)),
    }


def dense(assembly, blocks):
    full = np.zeros((assembly.n, 3, assembly.n, 3))
    full[assembly.pattern.columns, :, assembly.pattern.rows] = blocks.transpose(0, 2, 1)
    full[assembly.pattern.rows, :, assembly.pattern.columns] = blocks
    return full.reshape(3 * assembly.n, 3 * assembly.n)


@pytest.mark.parametrize("name", ["stretching", "shearing"])
@pytest.mark.parametrize("ratio", [0.0, 0.3, 1.0])
def test_kernels_compute_the_torch_functions(name, ratio):
    term = terms()[name]
    energies = InternalEnergy((term,))
    assembly = Assembly(12, energies, np.array([0]))
    factors = torch.linspace(0.5, 1.5, len(term.stencil), dtype=torch.float64)
    elements = energies.elements().scaled(**{name: factors})
    assembly.set_elements(elements)
    x = sheet(noise=0.2)
    k = energies.coefficients(torch.tensor([2.0, ratio], dtype=torch.float64))

    def unit(y):
        return torch.stack([energies.energy(y, row, elements) for row in torch.eye(2).double()])

    np.testing.assert_allclose(assembly.energies(x.numpy()), unit(x).numpy(), rtol=1e-12)
    slopes = jacobian(unit, x).numpy()
    np.testing.assert_allclose(assembly.gradients(x.numpy()), slopes, atol=1e-12 * np.abs(slopes).max())
    _, blocks = assembly.hessian(x.numpy(), k.numpy(), convex=False)
    exact = hessian(lambda y: energies.energy(y, k, elements), x).reshape(36, 36).numpy()
    np.testing.assert_allclose(dense(assembly, blocks), exact, atol=1e-10 * np.abs(exact).max())
    _, blocks = assembly.hessian(x.numpy(), k.numpy(), convex=True)
    values = np.linalg.eigvalsh(dense(assembly, blocks))
    assert values.min() >= -1e-12 * values.max()


def test_a_ratio_of_one_is_hooke_in_both_directions():
    x = sheet(noise=0.3)
    term = terms()["stretching"]
    both = term.energy_of(x, torch.tensor([3.0, 1.0], dtype=torch.float64))
    hooke = Stretching(term.stencil, term.rest).energy_of(x, torch.tensor([3.0], dtype=torch.float64))
    torch.testing.assert_close(both, hooke, rtol=1e-14, atol=0)


def test_what_only_pulls_does_not_push():
    values = torch.tensor([3.0, 0.0], dtype=torch.float64)
    for term in terms().values():
        assert float(term.energy_of(sheet((0.7, 0.8)), values)) == 0
        assert float(term.energy_of(sheet((1.1, 1.2)), values)) > 0


def test_a_small_shear_costs_what_the_docstring_says():
    angle, cells = 1e-4, 2 * 3
    term = terms()["shearing"]
    for ratio, share in ((1.0, 1.0), (0.0, 0.5)):
        energy = term.energy_of(sheet(shear=angle), torch.tensor([2.0, ratio], dtype=torch.float64))
        assert float(energy) == pytest.approx(cells * share * 2.0 * angle**2, rel=1e-3)
    paper = angles(GRID, terms()["stretching"].rest).named("shearing")
    full = float(paper.energy_of(sheet(shear=angle), torch.tensor([2.0], dtype=torch.float64)))
    assert full == pytest.approx(cells * 2 * 2.0 * angle**2, rel=1e-3)


def test_strains_agree_between_laws_at_small_angles():
    lengths = terms()["stretching"].rest
    for law in (angles, taut):
        strain = law(GRID, lengths).named("shearing").strain(sheet(shear=1e-3))
        torch.testing.assert_close(strain.abs(), torch.full_like(strain, 1e-3), rtol=2e-3, atol=0)


def test_rest_shape_and_parameters_of_the_taut_law():
    cloth = grid_cloth((4, 3), (0.3, 0.4), 0.1, (), law=taut)
    assert cloth.energies.parameters.names == (
        "stretching",
        "edge_compression",
        "shearing",
        "diagonal_compression",
        "bending",
    )
    i, j = torch.meshgrid(torch.arange(4.0), torch.arange(3.0), indexing="ij")
    flat = torch.stack((0.2 * j, 0.1 * i, 0 * i), -1).reshape(-1, 3).double()
    for term in cloth.energies:
        assert float(term.strain(flat).abs().max()) < 1e-6
    coefficients = cloth.energies.coefficients(torch.tensor([4.0, 0.5, 3.0, 0.1, 2.0], dtype=torch.float64))
    assert coefficients.tolist() == pytest.approx([4.0, 2.0, 3.0, 0.3, 2.0])
