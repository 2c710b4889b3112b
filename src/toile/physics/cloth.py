"""The cloth itself: elements, rest shape, masses and pinned vertices."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from toile.geometry.mesh import face_normals
from toile.physics.energies.bending import Bending
from toile.physics.energies.dihedral_bending import DihedralBending, rest_hinges
from toile.physics.energies.membrane import Membrane, NeoHookean, rest_triangles
from toile.physics.energies.shearing import Shearing
from toile.physics.energies.stretching import Stretching
from toile.physics.energies.term import InternalEnergy
from toile.physics.grid_laws import GridLaw, angles
from toile.physics.grid_lines import GridLines
from toile.physics.material import Material
from toile.physics.parameter_vector import ParameterVector
from toile.physics.stencils import Stencils, grid_stencils
from toile.physics.topology import Topology


@dataclass(frozen=True)
class Cloth:
    """A piece of cloth with N vertices, apart from its stiffness and its motion.

    Attributes:
        topology: faces and neighbours.
        energies: what resists its deformation, element by element.
        masses: (N,) float64 [kg].
        pinned: (n_pinned,) int64, vertices whose motion is prescribed.
        law: of a grid: makes its energies, on another grid as well.
        uneven: where the lines of a grid lie that are not evenly spaced; None where they are.
    """

    topology: Topology
    energies: InternalEnergy
    masses: Tensor
    pinned: Tensor
    law: GridLaw = angles
    uneven: GridLines | None = None

    def __post_init__(self) -> None:
        n = self.topology.n_vertices
        if tuple(self.masses.shape) != (n,):
            raise ValueError(f"masses: expected shape {(n,)}, got {tuple(self.masses.shape)}")
        if self.pinned.numel() and (int(self.pinned.min()) < 0 or int(self.pinned.max()) >= n):
            raise ValueError(f"pinned: expected vertex indices in [0, {n}), got {self.pinned.tolist()}")
        for term in self.energies:
            index = term.stencil
            if index.numel() and (int(index.min()) < 0 or int(index.max()) >= n):
                raise ValueError(
                    f"{term.name}: expected vertex indices in [0, {n}), "
                    f"got [{int(index.min())}, {int(index.max())}]"
                )

    @property
    def n_vertices(self) -> int:
        """Number of vertices N."""
        return self.topology.n_vertices

    @property
    def grid(self) -> tuple[int, int] | None:
        """(H, W) if the vertices form a grid, else None."""
        return self.topology.grid

    @cached_property
    def lines(self) -> GridLines:
        """Where the lines of the grid lie.

        Raises:
            ValueError: the vertices form no grid.
        """
        if self.grid is None:
            raise ValueError("lines: expected a cloth on a grid, got a general mesh")
        return GridLines.even(*self.grid) if self.uneven is None else self.uneven

    @cached_property
    def stencils(self) -> Stencils:
        """Elements of a cloth with warp and weft."""
        of = self.energies.named
        return Stencils(
            self.n_vertices, of("stretching").stencil, of("shearing").stencil, of("bending").stencil
        )

    @property
    def rest_lengths(self) -> Tensor:
        """Of the edges along warp and weft, (E,) [m]."""
        return self.energies.named("stretching").rest

    def material(self, **values: Tensor | float) -> Material:
        """Material of this cloth from values by name, numbers or tensors (B,)."""
        return Material.of(self.energies.parameters, values)


GRID_PARAMETERS = ParameterVector((*Stretching.parameters, *Shearing.parameters, *Bending.parameters))
"""What the internal energy of a grid depends on: Y, S and B."""


def grid_material(stretching: Tensor | float, shearing: Tensor | float, bending: Tensor | float) -> Material:
    """Material of a grid from Y [N/m], S and B [N·m], numbers or tensors (batch,)."""
    return Material.of(GRID_PARAMETERS, {"stretching": stretching, "shearing": shearing, "bending": bending})


def cell_shares(height: int, width: int) -> Tensor:
    """Cells of a grid that belong to each vertex, (H, W): 1 inside, ½ on the border, ¼ at a corner."""
    shares = torch.ones(height, width, dtype=torch.float64)
    shares[[0, -1], :] *= 0.5
    shares[:, [0, -1]] *= 0.5
    return shares


def grid_masses(height: int, width: int, cloth_size: tuple[float, float], areal_density: float) -> Tensor:
    """Vertex masses (H·W,) [kg] of a uniform sheet: ρ times the area of each vertex's cells (paper, 3.1.3).

    Args:
        height: number of vertices H along grid axis 0.
        width: number of vertices W along grid axis 1.
        cloth_size: rest lengths of the two sides [m].
        areal_density: ρ [kg/m²].
    """
    cell = cloth_size[0] * cloth_size[1] / ((height - 1) * (width - 1))
    return (areal_density * cell * cell_shares(height, width)).reshape(-1)


def uniform_rest_lengths(
    stencils: Stencils, grid: tuple[int, int], cloth_size: tuple[float, float]
) -> Tensor:
    """Rest length of every edge of a flat grid of the given size [m] (as in the paper)."""
    along_i = (stencils.edges[:, 1] - stencils.edges[:, 0]) == grid[1]
    step_i, step_j = cloth_size[0] / (grid[0] - 1), cloth_size[1] / (grid[1] - 1)
    # Python numbers in torch.where would be rounded to float32.
    steps = torch.tensor([step_j, step_i], dtype=torch.float64)
    return steps[along_i.long()]


def template_rest_lengths(stencils: Stencils, template: Tensor) -> Tensor:
    """Rest length of every edge as measured on the template (..., N, 3) [m]."""
    flat = template.reshape(-1, 3).to(torch.float64)
    return (flat[stencils.edges[:, 1]] - flat[stencils.edges[:, 0]]).norm(dim=-1)


def grid_cloth(
    grid: tuple[int, int],
    cloth_size: tuple[float, float],
    areal_density: float,
    pinned: tuple[int, ...],
    rest_lengths: Tensor | None = None,
    law: GridLaw = angles,
    lines: GridLines | None = None,
) -> Cloth:
    """A rectangular cloth on an H×W grid, flat at rest.

    Args:
        grid: (H, W).
        cloth_size: rest lengths of the sides along grid axis 0 and axis 1 [m].
        areal_density: [kg/m²].
        pinned: flattened indices of pinned vertices.
        rest_lengths: (E,) [m]; uniform if None.
        law: which energies resist its deformation.
        lines: of the grid; evenly spaced if None. Stiffnesses are those of an even grid of as many vertices,
            of which it is the same sheet.
    """
    if lines is not None and lines.grid != grid:
        raise ValueError(f"lines: expected those of a grid of {grid}, got {lines.grid}")
    uneven = None if lines is None or lines.is_even else lines
    if rest_lengths is None:
        rest_lengths = (
            uniform_rest_lengths(grid_stencils(*grid), grid, cloth_size)
            if uneven is None
            else _line_distances(uneven, cloth_size)
        )
    energies = law(grid, rest_lengths.to(torch.float64))
    masses = grid_masses(*grid, cloth_size, areal_density)
    if uneven is not None:
        energies = energies.with_factors(_element_factors(energies, uneven))
        masses = masses.sum() * uneven.areas()
    return Cloth(
        topology=Topology.of_grid(*grid),
        energies=energies,
        masses=masses,
        pinned=torch.tensor(pinned, dtype=torch.int64),
        law=law,
        uneven=uneven,
    )


def _element_factors(energies: InternalEnergy, lines: GridLines) -> dict[str, Tensor]:
    """Of the energies of a grid, by name; see GridLines."""
    factors = lines.element_factors()
    diagonals = energies.named("shearing").stencil.shape[1] == 2
    return {
        "stretching": factors["edges"],
        "shearing": factors["diagonals" if diagonals else "corners"],
        "bending": factors["straights"],
    }


def _line_distances(lines: GridLines, cloth_size: tuple[float, float]) -> Tensor:
    """Rest length of every edge of a flat sheet with these lines [m]."""
    H, W = lines.grid
    first, second = (p.diff() * side for p, side in zip(lines.places(), cloth_size, strict=True))
    return torch.cat((first.repeat_interleave(W), second.repeat(H)))


def mesh_masses(positions: Tensor, faces: Tensor, areal_density: float) -> Tensor:
    """Vertex masses (N,) [kg] of a triangle mesh: ρ times a third of every face around a vertex."""
    areas = 0.5 * face_normals(positions.to(torch.float64), faces).norm(dim=-1)
    masses = torch.zeros(len(positions), dtype=torch.float64)
    for corner in range(3):
        masses = masses.index_add(0, faces[:, corner], areas * (areal_density / 3))
    return masses


def mesh_cloth(
    rest: Tensor,
    faces: Tensor,
    areal_density: float,
    pinned: tuple[int, ...],
    membrane: type[Membrane] = NeoHookean,
    *,
    flat: bool = True,
) -> Cloth:
    """A cloth on any manifold triangle mesh: a membrane and bending at the inner edges.

    Args:
        rest: positions at rest (N, 3) [m].
        faces: (T, 3), all turned to the same side.
        areal_density: [kg/m²].
        pinned: indices of pinned vertices.
        membrane: which energy of in-plane strain.
        flat: it wants to be flat, as woven; else it keeps the angles of ``rest``.
    """
    topology = Topology(len(rest), faces)
    return Cloth(
        topology=topology,
        energies=InternalEnergy(
            (
                membrane(topology.faces, rest_triangles(rest, topology.faces)),
                DihedralBending(topology.hinges, rest_hinges(rest, topology.hinges, flat=flat)),
            )
        ),
        masses=mesh_masses(rest, topology.faces, areal_density),
        pinned=torch.tensor(pinned, dtype=torch.int64),
    )
