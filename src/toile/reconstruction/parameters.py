"""Everything a fit may change, as one module with named parameters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import torch
from torch import Tensor, nn

from toile.limits import Positive, Unit
from toile.physics.cloth import GRID_PARAMETERS
from toile.physics.material import Material
from toile.physics.parameter_vector import ParameterVector
from toile.physics.units import NetworkUnits


class ClothParameters(nn.Module):
    """Unknowns of one reconstruction; N vertices, F frames, n pinned vertices.

    Attributes:
        stretching, shearing, bending: stiffnesses in the paper's network units (edge 1, frame interval 1,
            interior mass 1), shape ().
        wind: constant external force per mass beside gravity [m/s²], shape (3,).
        turbulence: external force that varies over vertices and frames, divided by an interior vertex's mass
            [m/s²], shape (F-1, N, 3); entry t acts between frame t and frame t + 1.
        boundary_motion: displacement of the pinned vertices from the template [m], shape (F, n, 3).
        texture_offset: change of the texture coordinates, shape (N, 2).

    Args:
        of_cloth: what the cloth's law depends on; a grid's stiffnesses are among it.
    """

    NAMES = (*GRID_PARAMETERS.names, "wind", "turbulence", "boundary_motion", "texture_offset")
    STIFFNESSES = GRID_PARAMETERS.names

    def __init__(
        self,
        n_frames: int,
        n_vertices: int,
        n_pinned: int,
        units: NetworkUnits,
        *,
        stretching: Annotated[Positive, Unit("network units")],
        shearing: Annotated[Positive, Unit("network units")],
        bending: Annotated[Positive, Unit("network units")],
        of_cloth: ParameterVector = GRID_PARAMETERS,
    ) -> None:
        super().__init__()
        self._of_cloth = of_cloth
        double = torch.float64
        self.units = units
        stiffnesses = {"stretching": stretching, "shearing": shearing, "bending": bending}
        for name in GRID_PARAMETERS.names:
            self.register_parameter(name, nn.Parameter(torch.tensor(stiffnesses[name], dtype=double)))
        self.wind = nn.Parameter(torch.zeros(3, dtype=double))
        self.turbulence = nn.Parameter(torch.zeros(n_frames - 1, n_vertices, 3, dtype=double))
        self.boundary_motion = nn.Parameter(torch.zeros(n_frames, n_pinned, 3, dtype=double))
        self.texture_offset = nn.Parameter(torch.zeros(n_vertices, 2, dtype=double))

    @property
    def stiffness_units(self) -> Tensor:
        """SI per network unit of every stiffness, in the order of ``GRID_PARAMETERS``."""
        return torch.tensor([self.units.of(p.unit) for p in GRID_PARAMETERS], dtype=torch.float64)

    def stiffness(self) -> Tensor:
        """Stiffnesses in network units without gradients, in the order of ``GRID_PARAMETERS``."""
        return torch.stack([self.get_parameter(name) for name in GRID_PARAMETERS.names]).detach()

    @torch.no_grad()
    def set_stiffness(self, values: Sequence[float]) -> None:
        """Set them, in network units."""
        for name, value in GRID_PARAMETERS.unpack(values).items():
            self.get_parameter(name).fill_(float(value))

    def material(self) -> Material:
        """The cloth with its stiffnesses as they are, batch of one."""
        return self.material_of([self.get_parameter(p.name) * self.units.of(p.unit) for p in GRID_PARAMETERS])

    def material_of(self, stiffness: Sequence[Tensor]) -> Material:
        """The cloth with stiffnesses in SI units, and what else its law has at the defaults; batch of one."""
        return Material.of(self._of_cloth, GRID_PARAMETERS.unpack(stiffness))

    def forces(self, masses: Tensor, gravity: Tensor, first: int, last: int) -> Tensor:
        """External forces of frames first + 1 ... last, (last - first, N, 3) [N].

        Args:
            masses: (N,) [kg].
            gravity: (3,) [m/s²].
            first: first frame of the window.
            last: last frame of the window.
        """
        constant = masses[:, None] * (gravity + self.wind)
        return constant + self.units.mass * self.turbulence[first:last]
