"""Very long motions all over the material box: energy over time, and whether the cloth comes to rest."""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from surrogate.cases import AREAL_DENSITY, BOX, EDGE, GRAVITY
from surrogate.contenders import Build, solver
from toile.physics.cloth import Cloth, grid_cloth, grid_material
from toile.physics.implicit.assembly import Assembly
from toile.physics.implicit.integrators import BackwardEuler
from toile.physics.linearizable import LinearizableSimulator
from toile.physics.material import Material
from toile.physics.simulator import StepStatus
from toile.physics.state import State
from toile.physics.units import NetworkUnits

GRAVITY_NUMBER = 0.05  # network units
LEAN = 60.0  # of the sheet at the start [degrees]
REST = 1e-4  # largest speed that is called rest, edge lengths per step
WINDOW = 100  # steps, over which the largest speed is taken
SOLVER_SECONDS = 4.0  # the solver's motion of one material is given up after this long
_SEED = 74_000_000


@dataclass(frozen=True)
class StabilitySettings:
    """How long.

    Attributes:
        grid: (H, W).
        steps: of the contender.
        solver_steps: of the solver, beside which the contender's first steps are put.
        every: steps between two rows.
        levels: values of every stiffness.
    """

    grid: tuple[int, int] = (12, 12)
    steps: int = 10_000
    solver_steps: int = 1_000
    every: int = 100
    levels: int = 3


@dataclass(frozen=True)
class _Sheet:
    """A flat sheet pinned at its upper corners, leaning, and its materials."""

    cloth: Cloth
    time_step: float
    positions: Tensor
    stiffness: Tensor
    forces: Tensor
    numbers: list[tuple[float, ...]]

    def start(self, chosen: slice, n_past: int) -> tuple[State, Material, Tensor, Tensor]:
        """What a step needs, for some of the materials."""
        k = self.stiffness[chosen]
        x = self.positions.expand(len(k), -1, -1).contiguous()
        state = State.start(x, torch.zeros_like(x), self.time_step, n_past)
        return (
            state,
            grid_material(*k.unbind(-1)),
            self.forces.expand_as(x).contiguous(),
            x[:, self.cloth.pinned],
        )


@torch.no_grad()
def stability(
    contenders: dict[str, Build], settings: StabilitySettings, only: Sequence[tuple[float, ...]] | None = None
) -> pd.DataFrame:
    """Energy and speed over time, one row per contender, material and measurement.

    Energy is kinetic, internal and that of gravity, above its value at the start and in units of the cloth's
    weight times its side; "largest energy" is over all steps since the row before, and so is the speed of
    the fastest vertex, in edge lengths per step.

    Args:
        contenders: by name.
        settings: see there.
        only: Y, S, B of the materials, of all those of the settings; None for all.
    """
    sheet = _sheet(settings)
    if only is not None:
        # Numbers from a table have lost digits.
        chosen = [
            k for k, own in enumerate(sheet.numbers) if any(np.allclose(own, o, rtol=1e-3) for o in only)
        ]
        kept = [sheet.numbers[k] for k in chosen]
        sheet = replace(sheet, numbers=kept, stiffness=sheet.stiffness[chosen])
    tables = []
    for name, build in contenders.items():
        simulator = build(sheet.cloth, sheet.time_step, BackwardEuler())
        table, _ = _motion(simulator, sheet, slice(None), settings.steps, settings.every, math.inf)
        tables.append(table.assign(contender=name))
        print(f"  {name} done", flush=True)
    return pd.concat(tables, ignore_index=True)


@torch.no_grad()
def stability_solver(settings: StabilitySettings) -> pd.DataFrame:
    """The same by the solver, one material after the other, each as far as it gets in a given time."""
    sheet = _sheet(settings)
    simulator = solver(sheet.cloth, sheet.time_step, BackwardEuler())
    tables = []
    for b, numbers in enumerate(sheet.numbers):
        table, end = _motion(
            simulator, sheet, slice(b, b + 1), settings.solver_steps, settings.every, SOLVER_SECONDS
        )
        tables.append(table.assign(end=end))
        print(f"  solver, Y, S, B = {numbers}: {int(table.step.max())} steps {end}", flush=True)
    return pd.concat(tables, ignore_index=True)


def _sheet(settings: StabilitySettings) -> _Sheet:
    height, width = settings.grid
    side = EDGE * (width - 1)
    cloth = grid_cloth(settings.grid, (EDGE * (height - 1), side), AREAL_DENSITY, (0, width - 1))
    step = math.sqrt(GRAVITY_NUMBER * EDGE / GRAVITY)
    i, j = torch.meshgrid(
        torch.arange(height, dtype=torch.float64), torch.arange(width, dtype=torch.float64), indexing="ij"
    )
    # Noise far below an edge, so that nothing balances on a ridge for ever.
    ripple = 0.01 * torch.randn(
        settings.grid, generator=torch.Generator().manual_seed(_SEED), dtype=torch.float64
    )
    ripple[0, [0, -1]] = 0
    positions = EDGE * torch.stack((j, i, ripple), -1).reshape(1, -1, 3)
    lean = math.radians(LEAN)
    down = torch.tensor([0.0, math.cos(lean), math.sin(lean)], dtype=torch.float64)
    bounds = (BOX.stretching, BOX.shearing, BOX.bending)
    values = [np.geomspace(low, high, settings.levels).tolist() for low, high in bounds]
    numbers = list(itertools.product(*values))
    units = NetworkUnits(AREAL_DENSITY * EDGE**2, EDGE, step)
    scale = torch.tensor([units.stretching, units.energy, units.energy], dtype=torch.float64)
    stiffness = torch.tensor(numbers, dtype=torch.float64) * scale
    return _Sheet(cloth, step, positions, stiffness, cloth.masses[:, None] * GRAVITY * down, numbers)


def _motion(
    simulator: LinearizableSimulator, sheet: _Sheet, chosen: slice, steps: int, every: int, seconds: float
) -> tuple[pd.DataFrame, str]:
    """Measurements of some materials in one batch, and why they ended early ("" if they did not)."""
    state, material, forces, boundary = sheet.start(chosen, simulator.n_past)
    numbers = sheet.numbers[chosen]
    first = _energies(simulator.assembly, sheet, state, chosen)
    above = largest = fastest = np.zeros(len(numbers))
    rows: list[dict[str, float]] = []
    end, deadline = "", time.perf_counter() + seconds

    def note(step: int) -> None:
        for b, (y, s, bend) in enumerate(numbers):
            row = {"Y": y, "S": s, "B": bend, "step": step, "energy": float(above[b])}
            rows.append(row | {"largest energy": float(largest[b]), "speed": float(fastest[b])})

    note(0)
    largest = np.full(len(numbers), -np.inf)
    for n in range(1, steps + 1):
        result = simulator.step(state, material, forces, boundary)
        failed = [s for s in result.status if s is not StepStatus.CONVERGED]
        speed = (result.state.positions - state.positions).norm(dim=-1).amax(-1) / EDGE
        state = result.state
        above = _energies(simulator.assembly, sheet, state, chosen) - first
        # NaN stays NaN.
        largest, fastest = np.maximum(largest, above), np.maximum(fastest, speed.numpy())
        if len(numbers) == 1 and failed:
            # In a batch, one material that fails does not stop the others.
            end = failed[0].value
        elif time.perf_counter() > deadline:
            end = "out of time"
        if n % every == 0 or n == steps or end:
            note(n)
            largest, fastest = np.full(len(numbers), -np.inf), np.zeros(len(numbers))
        if end:
            break
    return pd.DataFrame(rows), end


def _energies(assembly: Assembly, sheet: _Sheet, state: State, chosen: slice) -> np.ndarray:
    """Kinetic, internal and gravity's energy of every material / (weight × side), (B,)."""
    masses = sheet.cloth.masses
    side = float(sheet.positions[0, :, 0].max())
    kinetic = 0.5 * (masses[:, None] * state.velocities.square()).sum((1, 2))
    falling = -(sheet.forces * state.positions).sum((1, 2))
    internal = [
        float(k.numpy() @ assembly.energies(x.numpy()))
        for k, x in zip(sheet.stiffness[chosen], state.positions, strict=True)
    ]
    total = kinetic.numpy() + falling.numpy() + np.array(internal)
    return total / (float(masses.sum()) * GRAVITY * side)  # type: ignore[no-any-return]
