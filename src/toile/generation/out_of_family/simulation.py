"""One sheet in motion with effects: small steps, what depends on the motion taken from the step's begin."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from toile.generation.motion import PinnedMotion
from toile.generation.out_of_family.interface import OutOfFamilyEffect, places_on
from toile.generation.simulation import Sheet
from toile.physics.elements import Elements
from toile.physics.implicit.integrators import BDF2
from toile.physics.implicit.newton import NewtonSettings
from toile.physics.implicit.simulator import ImplicitSimulator
from toile.physics.simulator import SimulationError, StepStatus
from toile.physics.state import State
from toile.physics.step_terms import StepContext


def simulate_out_of_family(
    sheet: Sheet,
    effects: Sequence[OutOfFamilyEffect],
    *,
    pinned_motion: PinnedMotion,
    gravity: Tensor,
    wind: Tensor,
    n_frames: int,
    fps: float,
    substeps: int,
    newton: NewtonSettings,
) -> Tensor:
    """Motion of a sheet that is at rest at frame 0, when the effects begin.

    Args:
        sheet: the cloth in its initial pose.
        effects: that act; () for the clip without any.
        pinned_motion: of the pinned vertices.
        gravity: (3,) [m/s²].
        wind: (3,) [m/s²].
        n_frames: F.
        fps: declared frames per second.
        substeps: steps per frame.
        newton: accuracy of every step.

    Returns:
        Positions of every step ((F - 1)·substeps + 1, H, W, 3) [m]; every substeps-th is a frame.

    Raises:
        SimulationError: a step did not converge.
    """
    interval = 1 / fps
    for effect in effects:
        effect.begin()
        interval = effect.frame_interval(interval)
        gravity = effect.gravity(gravity)
    cloth = sheet.cloth
    places = places_on(sheet.grid)
    masses = cloth.masses
    for effect in effects:
        masses = effect.masses(masses, places)
    cloth = replace(cloth, masses=masses)
    step = interval / substeps
    n_steps = (n_frames - 1) * substeps
    # The hand moves by the clock of the declared frames: a wrong frame rate changes how it is seen, too.
    times = step * torch.arange(n_steps + 1, dtype=torch.float64)
    path = pinned_motion.displacement(times)[:, None]
    for effect in effects:
        path = path + effect.boundary(times)
    start = sheet.pose.reshape(1, -1, 3)
    boundary = start[:, cloth.pinned] + path
    simulator = _ElementSimulator(sheet, step, newton, cloth.masses)
    state = State.start(start, torch.zeros_like(start), step, simulator.n_past)
    constant = masses[:, None] * (gravity + wind)
    motion = [sheet.pose.reshape(-1, 3)]
    changing = [e for e in effects if type(e).elements is not OutOfFamilyEffect.elements]
    pushing = [e for e in effects if type(e).acceleration is not OutOfFamilyEffect.acceleration]
    nominal = cloth.energies.elements()
    for n in range(1, n_steps + 1):
        forces = constant
        if changing or pushing:
            now = StepContext(
                cloth=cloth,
                material=sheet.material,
                # Where the cloth is about to be: forces that lag by a step feed energy to contacts.
                positions=state.positions[0] + step * state.velocities[0],
                velocities=state.velocities[0],
                time=float(times[n]),
                time_step=step,
                boundary=boundary[n],
            )
            for effect in pushing:
                acceleration = effect.acceleration(now)
                if acceleration is not None:
                    forces = forces + masses[:, None] * acceleration
            elements = nominal
            for effect in changing:
                elements = effect.elements(elements, now)
            if changing:
                simulator.use(elements)
        result = simulator.step(state, sheet.material, forces[None], boundary[None, n])
        if result.status[0] is not StepStatus.CONVERGED:
            raise SimulationError(
                f"generator: step {n} of {n_steps} failed ({result.status[0].value}). Try more sub-steps, a "
                "weaker effect or another seed."
            )
        state = result.state
        motion.append(state.positions[0])
    return torch.stack(motion).reshape(n_steps + 1, *sheet.pose.shape)


class _ElementSimulator(ImplicitSimulator):
    """The package's solver with stiffness factors and rest shapes that are set before a step."""

    def __init__(self, sheet: Sheet, step: float, newton: NewtonSettings, masses: Tensor) -> None:
        super().__init__(replace(sheet.cloth, masses=masses), step, BDF2(), newton)

    def use(self, elements: Elements) -> None:
        """Take these elements from the next step on."""
        self.assembly.set_elements(elements)
