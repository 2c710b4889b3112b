"""Cloths that the surrogate has never seen, in three regimes; each one follows from its seed.

| regime | what | Y, S, B at the effective step βh | gravity |
|---|---|---|---|
| fits | as in fits of videos | 222–1111, 0.22–5.6, 0.022–0.56 | 9.81 m/s²; BDF2, 0.01 s, 0.3–0.6 m |
| box | the training box | 10–10⁴, 0.01–10, 0.001–10 | 0.001–0.7 |
| corners | its eight corners | bounds of the box | 0.01, 0.1, 0.5 in turn |

Box and corners are cloths of real weight too: their time step is the one at which gravity of 9.81 m/s² is the
wanted number, so that the solver's tolerance means the same share of the weight everywhere.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from toile.learning.surrogate.distributions import normal, uniform
from toile.learning.surrogate.forces import Accelerations, ForceSampler, acceleration_field
from toile.learning.surrogate.materials import MaterialRanges
from toile.learning.surrogate.pinned_corners import (
    PinnedCornerSampler,
    border_lengths,
    corner_indices,
    within_reach,
)
from toile.learning.surrogate.rest_shapes import RestShapes, RestShapeSampler
from toile.physics.cloth import Cloth, grid_cloth, grid_material, template_rest_lengths
from toile.physics.implicit.integrators import BDF2, BackwardEuler, Integrator
from toile.physics.material import Material
from toile.physics.state import State
from toile.physics.stencils import grid_stencils
from toile.physics.units import PAPER_TIME_STEP, NetworkUnits

REGIMES = ("fits", "box", "corners")
# Training draws from generators with seeds 0 + 1000003 k, its validation from 12345.
FIRST_SEED = {"fits": 71_000_000, "box": 72_000_000, "corners": 73_000_000}
GRAVITY = 9.81  # [m/s²]
AREAL_DENSITY = 0.15  # [kg/m²]
EDGE = 0.02  # [m], of cloths in network units
FITS_STEP = 0.01  # [s]
# As in conf/training/pool/default.yaml, from which the network learns.
BOX = MaterialRanges(stretching=(10.0, 1e4), shearing=(0.01, 10.0), bending=(0.001, 10.0))
BOX_FORCES = ForceSampler(
    (0.001, 0.7), wind=0.7, turbulence=1.0, turbulence_grid=8, turbulence_persistence=0.95
)
BOX_CORNERS = PinnedCornerSampler((0.05, 0.1, 0.75, 0.1), speed=0.3, individual=0.3, persistence=0.97)
SHAPES = RestShapeSampler(scatter=0.04)
# Quoted at 0.02 s, as everywhere in the configuration; and light wind [m/s²].
FITS = MaterialRanges(stretching=(2e3, 1e4), shearing=(2.0, 50.0), bending=(0.2, 5.0))
FITS_WIND = 1.0
FITS_TURBULENCE = 1.0
CORNER_GRAVITIES = (0.01, 0.1, 0.5)


@dataclass(frozen=True)
class Case:
    """One cloth, what acts on it, and where it starts; at rest, flat.

    Attributes:
        regime: see the module's text.
        seed: everything random follows from it.
        cloth: with pinned corners.
        integrator: of all simulators that are compared.
        time_step: h of one step [s].
        positions: (1, N, 3) [m].
        material: (1,) each.
        forces: external force in every step, gravity included, (1, T, N, 3) [N].
        boundary: positions of the pinned vertices, (1, T + 1, n_pinned, 3) [m].
        width: side of the cloth [m].
        numbers: Y, S, B and gravity in network units at the effective step.
    """

    regime: str
    seed: int
    cloth: Cloth
    integrator: Integrator
    time_step: float
    positions: Tensor
    material: Material
    forces: Tensor
    boundary: Tensor
    width: float
    numbers: dict[str, float]

    @property
    def n_steps(self) -> int:
        """T."""
        return self.forces.shape[1]

    @property
    def edge(self) -> float:
        """Mean rest length [m]."""
        return float(self.cloth.rest_lengths.mean())

    def start(self, n_past: int) -> State:
        """The cloth at rest."""
        return State.start(self.positions, torch.zeros_like(self.positions), self.time_step, n_past)


def make_cases(regime: str, count: int, grid: tuple[int, int], n_steps: int) -> list[Case]:
    """The first cases of a regime; of the corners, count is a limit."""
    seeds = range(FIRST_SEED[regime], FIRST_SEED[regime] + count)
    if regime == "fits":
        return [fits_case(seed, grid, n_steps) for seed in seeds]
    if regime == "box":
        return [box_case(seed, grid, n_steps) for seed in seeds]
    return [
        box_case(seed, grid, n_steps, numbers)
        for seed, numbers in zip(seeds, _corner_numbers(), strict=False)
    ]


def _corner_numbers() -> Iterator[tuple[float, ...]]:
    """Y, S, B and gravity: all eight corners, gravities in turn; then again with the next gravities."""
    corners = list(itertools.product(BOX.stretching, BOX.shearing, BOX.bending))
    for turn in range(len(CORNER_GRAVITIES)):
        for n in range(len(corners)):
            # Neighbours in this order (a Gray code) differ in one stiffness, so that the integrator, which
            # alternates, does not follow any of them.
            gravity = CORNER_GRAVITIES[(n + turn) % len(CORNER_GRAVITIES)]
            yield (*corners[n ^ (n >> 1)], gravity)


def fits_case(seed: int, grid: tuple[int, int], n_steps: int, shape_seed: int | None = None) -> Case:
    """A cloth as fits of videos have it, its upper corners held still.

    Args:
        seed: of everything.
        grid: (H, W).
        n_steps: T.
        shape_seed: of size and rest lengths where several cases shall share a cloth.
    """
    generator = torch.Generator().manual_seed(seed)
    own = torch.Generator().manual_seed(seed if shape_seed is None else shape_seed)
    width = grid[1]
    edge = _between(0.3, 0.6, own) / (width - 1)
    shapes = SHAPES.sample(1, grid, own)
    cloth = _cloth(shapes, edge, (0, width - 1))
    positions = shapes.positions.reshape(1, -1, 3) * edge
    quoted = FITS.sample(1, generator)[0].tolist()
    integrator = BDF2()
    effective = integrator.regular.effective_step * FITS_STEP
    units = NetworkUnits(AREAL_DENSITY * edge**2, edge, PAPER_TIME_STEP)
    down = _leaning(shapes.positions[0], generator)
    wind = normal((3,), generator).double() * _between(0.0, FITS_WIND, generator)
    strength = FITS_TURBULENCE * uniform(1, generator)
    accelerations = Accelerations(
        gravity=torch.tensor([GRAVITY]),
        steady=(GRAVITY * down + wind)[None].float(),
        turbulence=_turbulence(strength, generator),
        turbulence_strength=strength,
    )
    forces = _forces(accelerations, cloth, grid, n_steps, generator)
    scale = (effective / PAPER_TIME_STEP) ** 2
    return Case(
        regime="fits",
        seed=seed,
        cloth=cloth,
        integrator=integrator,
        time_step=FITS_STEP,
        positions=positions,
        material=_material(quoted, units),
        forces=forces,
        boundary=positions[:, None, cloth.pinned].repeat(1, n_steps + 1, 1, 1),
        width=edge * (width - 1),
        numbers=_numbers([scale * k for k in quoted], GRAVITY * effective**2 / edge),
    )


def box_case(
    seed: int, grid: tuple[int, int], n_steps: int, numbers: tuple[float, ...] | None = None
) -> Case:
    """A cloth from the training box, some of its corners held and moved; every other one by BDF2.

    Args:
        seed: of everything.
        grid: (H, W).
        n_steps: T.
        numbers: Y, S, B, gravity instead of random ones; two neighbouring corners are then held.
    """
    generator = torch.Generator().manual_seed(seed)
    shapes = SHAPES.sample(1, grid, generator)
    stiffness = BOX.sample(1, generator)[0].tolist() if numbers is None else list(numbers[:3])
    bounds = BOX_FORCES.gravity if numbers is None else (numbers[3], numbers[3])
    forces = ForceSampler(
        bounds,
        BOX_FORCES.wind,
        BOX_FORCES.turbulence,
        BOX_FORCES.turbulence_grid,
        BOX_FORCES.turbulence_persistence,
    ).sample(1, generator)
    gravity = float(forces.gravity)
    pinned = BOX_CORNERS.sample_pinned(1, generator)
    if numbers is not None:
        pinned = torch.tensor([[True, True, False, False]])
    rows, columns = corner_indices(grid)
    vertices = [r * grid[1] + c for r, c in zip(rows, columns, strict=True)]
    cloth = _cloth(shapes, EDGE, tuple(v for v, h in zip(vertices, pinned[0].tolist(), strict=True) if h))
    effective = math.sqrt(gravity * EDGE / GRAVITY)
    units = NetworkUnits(AREAL_DENSITY * EDGE**2, EDGE, effective)
    integrator: Integrator = BDF2() if seed % 2 else BackwardEuler()
    # From acceleration in network units to m/s².
    to_si = EDGE / effective**2
    scaled = Accelerations(
        forces.gravity, forces.steady * to_si, forces.turbulence * to_si, forces.turbulence_strength * to_si
    )
    external = _forces(scaled, cloth, grid, n_steps, generator)
    positions = shapes.positions.reshape(1, -1, 3) * EDGE
    corners = _moving_corners(shapes, vertices, pinned, gravity, n_steps, generator) * EDGE
    return Case(
        regime="box" if numbers is None else "corners",
        seed=seed,
        cloth=cloth,
        integrator=integrator,
        time_step=effective / integrator.regular.effective_step,
        positions=positions,
        material=_material(stiffness, units),
        forces=external,
        boundary=corners[:, :, pinned[0]],
        width=EDGE * (grid[1] - 1),
        numbers=_numbers(stiffness, gravity),
    )


def _cloth(shapes: RestShapes, edge: float, pinned: tuple[int, ...]) -> Cloth:
    grid = (shapes.positions.shape[1], shapes.positions.shape[2])
    size = (edge * (grid[0] - 1), edge * (grid[1] - 1))
    lengths = template_rest_lengths(grid_stencils(*grid), shapes.positions[0] * edge)
    return grid_cloth(grid, size, AREAL_DENSITY, pinned, lengths)


def _material(stiffness: list[float], units: NetworkUnits) -> Material:
    y, s, b = stiffness
    si = (y * units.stretching, s * units.energy, b * units.energy)
    return grid_material(*(torch.tensor([k], dtype=torch.float64) for k in si))


def _numbers(stiffness: list[float], gravity: float) -> dict[str, float]:
    return dict(zip(("Y", "S", "B", "gravity"), (*stiffness, gravity), strict=True))


def _between(low: float, high: float, generator: torch.Generator) -> float:
    return low + (high - low) * float(uniform(1, generator))


def _leaning(flat: Tensor, generator: torch.Generator) -> Tensor:
    """Direction of gravity (3,) of a flat sheet (H, W, 3): along its columns, 80° off at most."""
    along = torch.nn.functional.normalize(flat[-1].mean(0) - flat[0].mean(0), dim=0)
    across = torch.nn.functional.normalize(flat[:, -1].mean(0) - flat[:, 0].mean(0), dim=0)
    across = torch.nn.functional.normalize(across - (across @ along) * along, dim=0)
    normal_ = torch.linalg.cross(along, across)
    lean = math.radians(_between(-80, 80, generator))
    roll = math.radians(_between(-10, 10, generator))
    down = math.cos(roll) * along + math.sin(roll) * across
    return math.cos(lean) * down + math.sin(lean) * normal_


def _turbulence(strength: Tensor, generator: torch.Generator) -> Tensor:
    side = BOX_FORCES.turbulence_grid
    return normal((1, side, side, 3), generator) * strength[:, None, None, None]


def _forces(
    accelerations: Accelerations,
    cloth: Cloth,
    grid: tuple[int, int],
    n_steps: int,
    generator: torch.Generator,
) -> Tensor:
    """External forces (1, T, N, 3) [N] from accelerations [m/s²]; the turbulence goes on."""
    turbulence, fields = accelerations.turbulence, []
    for _ in range(n_steps):
        fields.append(acceleration_field(accelerations.steady, turbulence, grid).reshape(1, -1, 3))
        turbulence = BOX_FORCES.next_turbulence(turbulence, accelerations.turbulence_strength, generator)
    return torch.stack(fields, 1).double() * cloth.masses[:, None]


def _moving_corners(
    shapes: RestShapes,
    vertices: list[int],
    pinned: Tensor,
    gravity: float,
    n_steps: int,
    generator: torch.Generator,
) -> Tensor:
    """Where the corners are led, (1, T + 1, 4, 3) in edge lengths, in training's order."""
    speed = BOX_CORNERS.sample_speed(torch.tensor([gravity]), generator)
    velocities = BOX_CORNERS.sample_velocities(speed, generator)
    lengths = border_lengths(shapes.rest_lengths_i, shapes.rest_lengths_j)
    path = [shapes.positions.reshape(1, -1, 3)[:, vertices]]
    for _ in range(n_steps):
        path.append(within_reach(path[-1] + velocities, pinned, lengths))
        velocities = BOX_CORNERS.next_velocities(velocities, speed, generator)
    return torch.stack(path, 1).double()
