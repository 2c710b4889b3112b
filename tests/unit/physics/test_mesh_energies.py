"""Energies of triangle meshes: kernels against plain torch, rest shapes, topologies, parameters."""

import math

import numpy as np
import pytest
import torch
from torch.autograd.functional import hessian, jacobian

from toile.physics.cloth import mesh_cloth
from toile.physics.energies.dihedral_bending import DihedralBending, dihedral_angles, rest_hinges
from toile.physics.energies.membrane import NeoHookean, StVenantKirchhoff, lame_constants, rest_triangles
from toile.physics.energies.term import InternalEnergy
from toile.physics.implicit.assembly import Assembly
from toile.physics.material import Material
from toile.physics.parameter_vector import Parameter, ParameterVector
from toile.physics.topology import Topology

# Seven vertices around one, with a fan of unequal triangles, and one more beyond.
PLANE = torch.tensor(
    [[0, 0], [1, 0.1], [0.6, 0.9], [-0.4, 1], [-1, 0.2], [-0.5, -0.9], [0.5, -1.1], [1.6, 0.9]]
).double()
FACES = torch.tensor([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5], [0, 5, 6], [0, 6, 1], [1, 7, 2]])
REST = 0.05 * torch.cat((PLANE, torch.zeros(8, 1).double()), 1)
TERMS = {
    "st_venant_kirchhoff": lambda top: StVenantKirchhoff(top.faces, rest_triangles(REST, top.faces)),
    "neo_hookean": lambda top: NeoHookean(top.faces, rest_triangles(REST, top.faces)),
    "flat hinges": lambda top: DihedralBending(top.hinges, rest_hinges(REST, top.hinges, flat=True)),
    "bent hinges": lambda top: DihedralBending(
        top.hinges, rest_hinges(deformed("bent"), top.hinges, flat=False)
    ),
}
COEFFICIENTS = {1: np.array([2e-3]), 2: np.array([3.0, 5.0])}


def deformed(kind):
    generator = torch.Generator().manual_seed(3)
    noise = torch.randn(8, 3, generator=generator, dtype=torch.float64)
    if kind == "bent":
        return REST + torch.stack((0 * PLANE[:, 0], 0 * PLANE[:, 0], 0.02 * PLANE[:, 0] ** 2), -1)
    if kind == "compressed":
        return REST * torch.tensor([0.7, 0.8, 1.0]) + 0.003 * noise
    return REST + {"crumpled": 0.012, "nearly at rest": 1e-6}[kind] * noise


def dense(assembly, blocks):
    full = np.zeros((assembly.n, 3, assembly.n, 3))
    full[assembly.pattern.columns, :, assembly.pattern.rows] = blocks.transpose(0, 2, 1)
    full[assembly.pattern.rows, :, assembly.pattern.columns] = blocks
    return full.reshape(3 * assembly.n, 3 * assembly.n)


@pytest.mark.parametrize("kind", ["crumpled", "nearly at rest", "compressed", "bent"])
@pytest.mark.parametrize("name", TERMS)
def test_kernels_compute_the_torch_functions(name, kind):
    term = TERMS[name](Topology(8, FACES))
    energies = InternalEnergy((term,))
    assembly = Assembly(8, energies, np.array([4]))
    factors = torch.linspace(0.5, 1.5, len(term.stencil), dtype=torch.float64)
    elements = energies.elements().scaled(**{term.name: factors})
    assembly.set_elements(elements)
    x, k = deformed(kind), COEFFICIENTS[term.n_coefficients]

    def unit(y):
        one = torch.eye(len(k), dtype=torch.float64)
        return torch.stack([energies.energy(y, row, elements) for row in one])

    np.testing.assert_allclose(assembly.energies(x.numpy()), unit(x).numpy(), rtol=1e-9, atol=1e-26)
    slopes = jacobian(unit, x).numpy()
    # At rest there is no force; what an angle is not known better than makes a tiny one.
    scale = np.abs(slopes).max() + 1e-3
    np.testing.assert_allclose(assembly.gradients(x.numpy()), slopes, rtol=0, atol=1e-11 * scale)
    exact = hessian(lambda y: torch.from_numpy(k) @ unit(y), x).reshape(24, 24).numpy()
    _, blocks = assembly.hessian(x.numpy(), k, convex=False)
    np.testing.assert_allclose(dense(assembly, blocks), exact, rtol=0, atol=1e-10 * np.abs(exact).max())
    _, convex = assembly.hessian(x.numpy(), k, convex=True)
    values = np.linalg.eigvalsh(dense(assembly, convex))
    assert values.min() >= -1e-12 * values.max()
    if np.linalg.eigvalsh(exact).min() > -1e-9 * values.max() and "hinges" not in name:
        # Nothing is dropped where nothing is indefinite.
        np.testing.assert_allclose(dense(assembly, convex), exact, rtol=0, atol=1e-8 * values.max())


def test_some_of_these_are_indefinite():
    """Else the test above would say nothing about the convex Hessian."""
    for name in TERMS:
        term = TERMS[name](Topology(8, FACES))
        assembly = Assembly(8, InternalEnergy((term,)), np.zeros(0, np.int64))
        k = COEFFICIENTS[term.n_coefficients]
        _, blocks = assembly.hessian(deformed("compressed").numpy(), k, convex=False)
        values = np.linalg.eigvalsh(dense(assembly, blocks))
        assert values.min() < -1e-3 * values.max(), name


def test_energies_at_small_strains_have_no_cancellation():
    """Energies of strains of 1e-7 are right to six digits: Newton's line search compares such."""
    top = Topology(8, FACES)
    strain = 1e-7
    stretched = REST * torch.tensor([1 + strain, 1.0, 1.0], dtype=torch.float64)
    area = float(rest_triangles(REST, FACES)[:, 3].sum())
    young, poisson = torch.tensor(60.0).double(), torch.tensor(0.3).double()
    lame, mu = lame_constants(young, poisson).tolist()
    expected = (0.5 * lame + mu) * strain**2 * area
    for name in ("st_venant_kirchhoff", "neo_hookean"):
        term = TERMS[name](top)
        energy = term.energy_of(stretched, torch.stack((young, poisson)))
        assert float(energy) == pytest.approx(expected, rel=1e-6)


def test_a_collapsed_triangle_is_finite():
    x = deformed("crumpled").clone()
    x[1] = x[0]
    for name in TERMS:
        term = TERMS[name](Topology(8, FACES))
        assembly = Assembly(8, InternalEnergy((term,)), np.zeros(0, np.int64))
        gradients, blocks = assembly.hessian(x.numpy(), COEFFICIENTS[term.n_coefficients], convex=False)
        assert np.isfinite(assembly.energies(x.numpy())).all()
        assert np.isfinite(gradients).all()
        assert np.isfinite(blocks).all()


def test_angles_have_the_sign_of_the_fold():
    hinge = torch.tensor([[0, 1, 2, 3]])
    for angle in (-2.5, -0.3, 0.0, 0.4, 3.0):
        # Edge along x, one face in the plane, the other turned about the edge.
        x = torch.tensor(
            [[0, 0, 0], [2, 0, 0], [1, 1, 0], [0.5, -math.cos(angle), -math.sin(angle)]], dtype=torch.float64
        )
        assert float(dihedral_angles(x, hinge)[0]) == pytest.approx(angle, abs=1e-12)


def test_neighbours_of_a_fan():
    top = Topology(8, FACES)
    assert top.edges.tolist() == sorted(top.edges.tolist())
    assert len(top.edges) == 14
    # Euler: one disc.
    assert 8 - len(top.edges) + len(FACES) == 1
    assert len(top.hinges) == 3 * len(FACES) - len(top.edges)
    for a, b, c, d in top.hinges.tolist():
        first = {tuple(np.roll(f, k)) for f in FACES.tolist() for k in range(3)}
        assert (a, b, c) in first
        assert (b, a, d) in first
    (rim,) = top.boundary
    assert sorted(rim.tolist()) == [1, 2, 3, 4, 5, 6, 7]
    assert top.neighbours[0].tolist() == [1, 2, 3, 4, 5, 6]
    assert top.neighbours[7].tolist() == [1, 2]


def test_a_closed_surface_has_no_boundary():
    tetrahedron = Topology(4, torch.tensor([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]]))
    assert tetrahedron.boundary == ()
    assert len(tetrahedron.hinges) == len(tetrahedron.edges) == 6


def test_bad_meshes_are_told():
    with pytest.raises(ValueError, match=r"all turn to the same side, got edge 0->1 in 2 faces"):
        Topology(4, torch.tensor([[0, 1, 2], [0, 1, 3]]))
    with pytest.raises(ValueError, match=r"vertex indices in \[0, 3\), got \[0, 5\]"):
        Topology(3, torch.tensor([[0, 1, 5]]))
    flat = torch.tensor([[0, 0, 0], [1, 0, 0], [2, 0, 0.0]]).double()
    with pytest.raises(ValueError, match="triangles with an area at rest, got none in 0"):
        mesh_cloth(flat, torch.tensor([[0, 1, 2]]), 0.2, ())


def test_parameters_by_name():
    cloth = mesh_cloth(REST, FACES, 0.2, ())
    vector = cloth.energies.parameters
    assert vector.names == ("young", "poisson", "bending")
    assert [p.unit for p in vector] == ["N/m", "", "N·m"]
    material = cloth.material(bending=1e-4, young=60.0, poisson=0.3)
    assert material.values.tolist() == [[60.0, 0.3, 1e-4]]
    assert material["poisson"].tolist() == [0.3]
    assert vector.violations([60.0, 1.2, math.nan]) == [
        "poisson: expected 0 to 0.95, got 1.2",
        "bending: expected 0 to inf N·m, got nan",
    ]
    with pytest.raises(KeyError, match="expected values of young, poisson, bending, got young"):
        cloth.material(young=1.0)
    with pytest.raises(KeyError, match="no parameter 'shearing'; there are young, poisson, bending"):
        material["shearing"]
    with pytest.raises(KeyError, match="no energy 'stretching'; it has neo_hookean, dihedral_bending"):
        cloth.energies.named("stretching")
    with pytest.raises(ValueError, match=r"\(B, 3\) for young, poisson, bending, got \(1, 2\)"):
        Material(vector, torch.ones(1, 2))
    with pytest.raises(ValueError, match="every name once, got a twice"):
        ParameterVector((Parameter("a", "A", ""), Parameter("a", "B", "")))
