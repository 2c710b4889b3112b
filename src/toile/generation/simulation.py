"""One sheet set in motion: the part that generating a scene and measuring its discretisation share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from toile.generation.motion import PinnedMotion
from toile.physics.cloth import Cloth, grid_cloth
from toile.physics.grid_laws import GridLaw, angles
from toile.physics.implicit.integrators import BDF2
from toile.physics.implicit.newton import NewtonSettings
from toile.physics.implicit.simulator import ImplicitSimulator
from toile.physics.material import Material
from toile.physics.rollout import rollout
from toile.physics.simulator import Simulator, StepResult
from toile.physics.state import State
from toile.progress import Report, silent


@dataclass(frozen=True)
class Sheet:
    """A cloth with its material, in one pose.

    Attributes:
        pose: positions (H, W, 3) [m], float64, camera frame.
        cloth: the cloth on that grid.
        material: stiffnesses (1,).
    """

    pose: Tensor
    cloth: Cloth
    material: Material

    @property
    def grid(self) -> tuple[int, int]:
        """Grid size (H, W)."""
        return int(self.pose.shape[0]), int(self.pose.shape[1])

    @staticmethod
    def of(
        pose: Tensor,
        cloth_size: tuple[float, float],
        areal_density: float,
        pinned: tuple[int, ...],
        material: Material,
        law: GridLaw = angles,
    ) -> Sheet:
        """A sheet that is flat and evenly spaced at rest; arguments as for grid_cloth.

        Of parameters that the law has beside those of the material, it has the law's own defaults.
        """
        grid = (int(pose.shape[0]), int(pose.shape[1]))
        cloth = grid_cloth(grid, cloth_size, areal_density, pinned, law=law)
        if cloth.energies.parameters != material.parameters:
            material = cloth.material(**material.parameters.unpack(material.values.unbind(1)))
        return Sheet(pose, cloth, material)


def simulate(
    sheet: Sheet,
    *,
    pinned_motion: PinnedMotion,
    acceleration: Tensor,
    n_frames: int,
    fps: float,
    substeps: int,
    newton: NewtonSettings,
    report: Report = silent,
) -> Tensor:
    """Motion of a sheet that is at rest at frame 0.

    Pinned vertices follow their motion exactly in every sub-step, not on straight lines between frames.

    Args:
        sheet: the cloth in its initial pose.
        pinned_motion: of the pinned vertices.
        acceleration: gravity plus wind, (3,) [m/s²], constant from frame 0 on.
        n_frames: number of frames F.
        fps: frames per second.
        substeps: BDF2 steps per frame.
        newton: accuracy of every step.
        report: told how many steps are done.

    Returns:
        Positions (F, H, W, 3) [m].

    Raises:
        SimulationError: a step did not converge.
    """
    step = 1 / (fps * substeps)
    n_steps = (n_frames - 1) * substeps
    simulator = _Counting(ImplicitSimulator(sheet.cloth, step, BDF2(), newton), n_steps, report)
    start = sheet.pose.reshape(1, -1, 3)
    times = step * torch.arange(n_steps + 1, dtype=torch.float64)
    boundary = start[:, sheet.cloth.pinned] + pinned_motion.displacement(times)[:, None]
    forces = (sheet.cloth.masses[:, None] * acceleration).expand(1, n_steps, -1, 3)
    state = State.start(start, torch.zeros_like(start), step, simulator.n_past)
    motion = rollout(simulator, state, sheet.material, forces, boundary[None], substeps=1)
    return motion.positions[0, ::substeps].reshape(n_frames, *sheet.pose.shape)


class _Counting(Simulator):
    """A simulator that reports its steps, and is the one it holds in everything else."""

    def __init__(self, simulator: Simulator, n_steps: int, report: Report) -> None:
        self._simulator, self._n_steps, self._report = simulator, n_steps, report
        self._done = 0
        self.time_step, self.n_past = simulator.time_step, simulator.n_past

    def step(self, *args: Any, **kwargs: Any) -> StepResult:
        """One step of the simulator."""
        result = self._simulator.step(*args, **kwargs)
        self._done += 1
        self._report("simulation", self._done, self._n_steps)
        return result
