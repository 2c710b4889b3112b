"""Frame 0 of a generated scene: a cloth at rest."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from toile.errors import InputError
from toile.generation.simulation import Sheet
from toile.physics.implicit.integrators import BackwardEuler
from toile.physics.implicit.newton import NewtonSettings
from toile.physics.implicit.simulator import ImplicitSimulator
from toile.physics.simulator import SimulationError, StepStatus
from toile.physics.state import State

_FIRST_STEP, _LAST_STEP = 0.02, 5.0  # [s]


def hanging_sheet(
    grid: tuple[int, int],
    cloth_size: tuple[float, float],
    *,
    pinned_distance: float,
    distance: float,
    yaw: float,
    gravity: tuple[float, float, float],
    seed: int,
) -> Tensor:
    """A smoothly bent sheet, upright before the camera, not yet in equilibrium.

    Axis 0 runs along the upper edge from left to right, axis 1 down. The upper corners are closer together
    than the cloth is wide; the excess goes into a random bend of long waves, which also breaks the symmetry.

    Args:
        grid: (H, W).
        cloth_size: rest length of the sides along axis 0 and 1 [m].
        pinned_distance: distance of the upper corners as a fraction of the side along axis 0, below 1.
        distance: z of the sheet's centre [m].
        yaw: angle by which the sheet is turned about the direction of gravity [rad].
        gravity: (3,) [m/s²], gives the direction down.
        seed: of the bend.

    Returns:
        Positions (H, W, 3) [m], float64, camera frame.

    Raises:
        InputError: ``pinned_distance`` is not in [0.5, 1), or gravity is zero or along the camera's x axis.
    """
    if not 0.5 <= pinned_distance < 1:
        raise InputError(
            "Distance of the pinned vertices is out of range",
            where="pinned_distance",
            expected="a fraction of the cloth's width in [0.5, 1)",
            got=str(pinned_distance),
        )
    right, down, forward = _upright_axes(gravity, yaw)
    u = torch.linspace(0, 1, grid[0], dtype=torch.float64)[:, None]
    v = torch.linspace(0, 1, grid[1], dtype=torch.float64)[None, :]
    rng = np.random.default_rng([seed, 0])
    bend = torch.zeros(grid, dtype=torch.float64)
    for m in (1, 2, 3):
        for n in (0, 1):
            weight = float(rng.uniform(0.5, 1.0)) * float(rng.choice((-1.0, 1.0))) / (m**1.5 * (1 + 2 * n))
            bend += weight * torch.sin(m * math.pi * u) * torch.cos(n * math.pi * v)
    bend *= cloth_size[0] * _amplitude(bend, pinned_distance)
    along = (u - 0.5) * pinned_distance * cloth_size[0]
    below = (v - 0.5) * cloth_size[1]
    centre = torch.tensor([0.0, 0.0, distance], dtype=torch.float64)
    return centre + along[..., None] * right + below[..., None] * down + bend[..., None] * forward


def settle(
    sheet: Sheet,
    acceleration: Tensor,
    newton: NewtonSettings,
    *,
    tolerance: float = 1e-3,
    max_steps: int = 80,
) -> Sheet:
    """Bring a sheet to a stable equilibrium by proximal minimisation of its potential energy.

    Every step is one of backward Euler without initial velocity, so the potential energy never rises; the
    steps grow until the inertia is negligible. Pinned vertices stay where they are.

    Args:
        sheet: in any pose without folds.
        acceleration: gravity plus wind, (3,) [m/s²].
        newton: accuracy of every step.
        tolerance: largest acceleration that is still called rest [m/s²].
        max_steps: steps before giving up.

    Raises:
        SimulationError: no equilibrium was reached.
    """
    cloth = sheet.cloth
    positions = sheet.pose.reshape(1, -1, 3)
    forces = (cloth.masses[:, None] * acceleration)[None]
    step = _FIRST_STEP
    left = math.inf
    for _ in range(max_steps):
        simulator = ImplicitSimulator(cloth, step, BackwardEuler(), newton)
        state = State.start(positions, torch.zeros_like(positions), step, simulator.n_past)
        result = simulator.step(state, sheet.material, forces, positions[:, cloth.pinned])
        if result.status[0] is not StepStatus.CONVERGED:
            step /= 4
            continue
        left = float((result.state.positions - positions).abs().max()) / step**2
        positions = result.state.positions
        if left <= tolerance:
            return replace(sheet, pose=positions.reshape(sheet.pose.shape))
        step = min(2 * step, _LAST_STEP)
    raise SimulationError(
        f"no equilibrium after {max_steps} steps: vertices still accelerate by {left:.3g} m/s², more than "
        f"the tolerance of {tolerance:g}. Try a stiffer bending or another pinned distance."
    )


def _upright_axes(gravity: tuple[float, float, float], yaw: float) -> tuple[Tensor, Tensor, Tensor]:
    """Unit vectors right, down and forward (3,) of a sheet that hangs along gravity and faces the camera."""
    g = torch.tensor(gravity, dtype=torch.float64)
    sideways = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    if float(torch.linalg.cross(g, sideways).norm()) <= 1e-9:
        raise InputError(
            "No sheet can hang upright before the camera",
            where="gravity",
            expected="a vector that is not zero and not along the camera's x axis",
            got=f"{list(gravity)} m/s²",
        )
    down = g / g.norm()
    sideways = sideways - (sideways @ down) * down
    sideways = sideways / sideways.norm()
    ahead = torch.linalg.cross(sideways, down)
    right = math.cos(yaw) * sideways + math.sin(yaw) * ahead
    return right, down, torch.linalg.cross(right, down)


def _amplitude(bend: Tensor, pinned_distance: float) -> float:
    """Factor on a bend (H, W) over a unit width with which its mean arc length along axis 0 is 1."""
    run = pinned_distance / (bend.shape[0] - 1)
    low, high = 0.0, 10.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        length = float(torch.sqrt((middle * bend.diff(dim=0)) ** 2 + run**2).sum(0).mean())
        low, high = (middle, high) if length < 1 else (low, middle)
    return 0.5 * (low + high)
