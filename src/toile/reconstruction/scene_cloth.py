"""From a scene to its cloth: rest lengths, masses and network units."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

from torch import Tensor

from toile.limits import Positive, Unit
from toile.physics.cloth import Cloth, grid_cloth, template_rest_lengths, uniform_rest_lengths
from toile.physics.grid_laws import GridLaw, angles
from toile.physics.stencils import grid_stencils
from toile.physics.units import PAPER_TIME_STEP, NetworkUnits
from toile.scenes.scene import Scene

RestLengths = Callable[[Scene], Tensor]
"""A function from a scene to the rest lengths (E,) [m] of its grid's edges."""


def uniform(scene: Scene) -> Tensor:
    """Every edge of a grid direction is equally long, side / (n - 1), as in the paper; (E,) [m]."""
    return uniform_rest_lengths(grid_stencils(*scene.grid), scene.grid, scene.cloth_size)


def template(scene: Scene) -> Tensor:
    """Every edge is as long as in the template; (E,) [m]."""
    return template_rest_lengths(grid_stencils(*scene.grid), scene.template)


def scene_cloth(
    scene: Scene,
    areal_density: Annotated[Positive, Unit("kg/m²")],
    rest_lengths: RestLengths,
    law: GridLaw = angles,
) -> Cloth:
    """The cloth of a scene.

    Args:
        scene: its grid, size and pinned vertices are used.
        areal_density: [kg/m²]; no video tells it.
        rest_lengths: uniform, template, or another function of that signature.
        law: which energies resist its deformation, see grid_laws.
    """
    return grid_cloth(
        scene.grid, scene.cloth_size, areal_density, scene.pinned_vertices, rest_lengths(scene), law
    )


def scene_units(scene: Scene, areal_density: float) -> NetworkUnits:
    """Network units of the grid at the paper's time step; of the mean spacing where the sides' differ."""
    H, W = scene.grid
    cell = scene.cloth_size[0] * scene.cloth_size[1] / ((H - 1) * (W - 1))
    return NetworkUnits(areal_density * cell, cell**0.5, PAPER_TIME_STEP)
