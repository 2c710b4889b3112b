"""One sheet in motion with effects: small steps, what depends on the motion taken from the step's begin."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from toile.generation.motion import PinnedMotion
from toile.generation.out_of_family.interface import OutOfFamilyEffect, places_on
from toile.generation.simulation import Sheet
from toile.physics.cloth import Cloth
from toile.physics.implicit.integrators import BDF2
from toile.physics.implicit.newton import NewtonSettings
from toile.physics.implicit.simulator import ImplicitSimulator
from toile.physics.material import Material
from toile.physics.rollout import rollout
from toile.physics.simulator import SimulationError, StepResult
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
    step = interval / substeps
    n_steps = (n_frames - 1) * substeps
    # The hand moves by the clock of the declared frames: a wrong frame rate changes how it is seen, too.
    times = step * torch.arange(n_steps + 1, dtype=torch.float64)
    path = pinned_motion.displacement(times)[:, None]
    for effect in effects:
        path = path + effect.boundary(times)
    start = sheet.pose.reshape(1, -1, 3)
    boundary = start[:, cloth.pinned] + path
    simulator = _ExplicitEffects(replace(sheet.cloth, masses=masses), step, newton, effects)
    state = State.start(start, torch.zeros_like(start), step, simulator.n_past)
    forces = (masses[:, None] * (gravity + wind)).expand(1, n_steps, -1, 3)
    try:
        motion = rollout(simulator, state, sheet.material, forces, boundary[None], substeps=1)
    except SimulationError as error:
        raise SimulationError(f"generator: {error} Or try a weaker effect, or another seed.") from error
    return motion.positions[0].reshape(n_steps + 1, *sheet.pose.shape)


class _ExplicitEffects(ImplicitSimulator):
    """The package's solver; what effects do in a step hangs on the motion at its begin, not within it.

    Args:
        cloth: with the masses that the effects make of it.
        step: [s].
        newton: accuracy of every step.
        effects: that act, begun.
    """

    def __init__(
        self, cloth: Cloth, step: float, newton: NewtonSettings, effects: Sequence[OutOfFamilyEffect]
    ) -> None:
        super().__init__(cloth, step, BDF2(), newton)
        self._changing = [e for e in effects if type(e).elements is not OutOfFamilyEffect.elements]
        self._pushing = [e for e in effects if type(e).acceleration is not OutOfFamilyEffect.acceleration]

    def step(
        self,
        state: State,
        material: Material,
        forces: Tensor,
        boundary: Tensor,
        guess: Tensor | None = None,
        *,
        linearize: bool = False,
    ) -> StepResult:
        """One step of one cloth, its stiffness factors, rest shapes and forces set before it."""
        if self._changing or self._pushing:
            now = StepContext(
                cloth=self.cloth,
                material=material,
                # Where the cloth is about to be: forces that lag by a step feed energy to contacts.
                positions=state.positions[0] + self.time_step * state.velocities[0],
                velocities=state.velocities[0],
                time=self.time_step * (state.steps + 1),
                time_step=self.time_step,
                boundary=boundary[0],
            )
            for effect in self._pushing:
                acceleration = effect.acceleration(now)
                if acceleration is not None:
                    forces = forces + self.cloth.masses[:, None] * acceleration
            if self._changing:
                elements = self.cloth.energies.elements()
                for effect in self._changing:
                    elements = effect.elements(elements, now)
                self.assembly.set_elements(elements)
        return super().step(state, material, forces, boundary, guess, linearize=linearize)
