"""Base fit and screening of everything that acts on the motion or on where it is seen."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from toile.diagnosis.base_fit import (
    BaseFit,
    base_deviations,
    base_sensitivities,
    fit_base,
    n_base,
    window_systems,
)
from toile.diagnosis.continuity import WindowSystem
from toile.diagnosis.effect_sensitivities import (
    FORCES,
    Instant,
    apparent_sensitivities,
    force_sensitivities,
    stretching_within,
)
from toile.diagnosis.evidence import DEFAULT, Evidence, EvidenceSettings
from toile.diagnosis.model_grid import ModelGrid
from toile.diagnosis.numerics import StepRefinement, refined
from toile.diagnosis.sensitivities import StepForces
from toile.diagnosis.shooting import Shooting, ShootingSettings, WindowMotion, changed_simulation
from toile.diagnosis.template_tension import template_tension
from toile.diagnosis.tracked import Tracked
from toile.effects.base import CameraEffect, Effect, ElementEffect, Surroundings
from toile.effects.strain_stiffening import StrainStiffening
from toile.geometry.camera import Camera
from toile.geometry.horizontal import horizontal_axes
from toile.physics.frame_steps import fewest_substeps
from toile.physics.implicit.integrators import BDF2
from toile.physics.implicit.newton import NewtonSettings
from toile.physics.implicit.simulator import ImplicitSimulator
from toile.scenes.scene import Scene
from toile.workers import ALONE, Workers

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Mechanics:
    """The base model of a clip, and what every effect would change about it.

    Attributes:
        shooting: the problem.
        fit: the base model.
        evidence: of hypotheses; none about effects before the base model's refit has converged, see refits.
        coefficients: (first, last + 1) of every effect's coefficients among those of all effects, by name.
        effects: by name.
        around: the nominal clip on the model's grid.
    """

    shooting: Shooting
    fit: BaseFit
    evidence: Evidence
    coefficients: dict[str, tuple[int, int]]
    effects: dict[str, Effect]
    around: Surroundings

    @property
    def width(self) -> float:
        """Of the cloth [m]."""
        return self.around.cloth_size[0]


def analyse_mechanics(
    scene: Scene,
    levels: Sequence[tuple[ModelGrid, Tracked]],
    effects: Sequence[Effect],
    settings: ShootingSettings,
    stiffness: tuple[float, float, float],
    longest_substep: float,
    n_frames: int,
    report: Callable[[str, float], None],
    workers: Workers = ALONE,
    refinement: StepRefinement | None = None,
    hypotheses: EvidenceSettings = DEFAULT,
) -> Mechanics:
    """Fit the base model to the first n_frames frames.

    Args:
        scene: its gravity, frame rate and camera are used.
        levels: grids and the motion on them, coarse to fine; each fit starts from the one before, and only
            the last one is kept.
        effects: candidates; those that act neither through forces nor the camera are passed over.
        settings: see ShootingSettings.
        stiffness: start values Y [N/m], S per cell area [N/m], B [N·m].
        longest_substep: [s].
        n_frames: frames used.
        report: called with a message and the cost.
        workers: share the windows.
        refinement: of the time step; None to leave it as it is.
        hypotheses: how the evidence of one is found.
    """
    fit: BaseFit | None = None
    for grid, tracked in levels:
        last = grid is levels[-1][0]
        shooting = shooting_of(scene, grid, tracked, settings, longest_substep)
        start = start_material(grid, stiffness)
        passes = None if last else 0
        fit = fit_base(shooting, tracked.positions[0], start, n_frames, report, fit, passes, workers)
    assert fit is not None
    if refinement is not None:
        nothing = refinement.tolerance * grid.cloth_size[0]
        shooting, fit = refined(shooting, fit, nothing, refinement.shortest, report, workers)
    around = surroundings(scene, grid)
    systems = effect_systems(shooting, fit, (), around, None, 0, workers)
    return mechanics_around(shooting, fit, systems, effects, around, hypotheses)


def start_material(grid: ModelGrid, stiffness: tuple[float, float, float]) -> Array:
    """Where a fit begins, (P,): stiffnesses, and what else the law has at its defaults.

    Args:
        grid: of the model.
        stiffness: Y [N/m], S per cell area [N/m], B [N·m].
    """
    y, s, b = stiffness
    values = {"stretching": y, "shearing": s * grid.units.length**2, "bending": b}
    return grid.cloth.material(**values).values[0].numpy()


def shooting_of(
    scene: Scene,
    grid: ModelGrid,
    tracked: Tracked,
    settings: ShootingSettings,
    longest_substep: float,
    newton_iterations: int | None = None,
) -> Shooting:
    """The problem on one grid.

    Args:
        scene: its gravity and frame rate are used.
        grid: of the model.
        tracked: motion on it.
        settings: see ShootingSettings.
        longest_substep: [s].
        newton_iterations: of a sub-step at most; None for as many as is usual.
    """
    substeps = fewest_substeps(1 / scene.fps, longest_substep)
    gravity = scene.gravity.numpy().astype(np.float64)
    horizontal = horizontal_axes(torch.from_numpy(gravity)).numpy()
    tension = template_tension(grid.cloth, tracked.positions[0], gravity, horizontal, settings.tension_ridge)
    newton = NewtonSettings(settings.newton_tolerance)
    if newton_iterations is not None:
        newton = replace(newton, max_iterations=newton_iterations)
    simulator = ImplicitSimulator(grid.cloth, 1 / scene.fps / substeps, BDF2(), newton, (tension,))
    pinned = grid.cloth.pinned.numpy()
    return Shooting(
        simulator,
        substeps,
        gravity,
        horizontal,
        grid.grid,
        tracked.positions[:, pinned],
        tracked,
        settings,
    )


def surroundings(scene: Scene, grid: ModelGrid) -> Surroundings:
    """The nominal clip on the model's grid."""
    gravity = torch.from_numpy(scene.gravity.numpy().astype(np.float64))
    return Surroundings(grid.cloth, grid.cloth_size, gravity, scene.fps, scene.n_frames)


def mechanics_around(
    shooting: Shooting,
    fit: BaseFit,
    systems: Sequence[WindowSystem],
    effects: Sequence[Effect],
    around: Surroundings,
    hypotheses: EvidenceSettings = DEFAULT,
) -> Mechanics:
    """What is known around a base model.

    Args:
        shooting: the problem.
        fit: the base model.
        systems: around it, of all windows, with the coefficients of all effects or without.
        effects: candidates; those that act neither through forces nor the camera are passed over.
        around: the nominal clip on the model's grid.
        hypotheses: how the evidence of one is found.
    """
    # At zero: what is asked is whether they act at all.
    acting = [
        effect.with_values(torch.zeros_like(effect.scales))
        for effect in effects
        if isinstance(effect, (*FORCES, CameraEffect))
    ]
    # Those that act through forces come first, see Shooting.normal.
    acting.sort(key=lambda effect: isinstance(effect, CameraEffect))
    coefficients, at = {}, 0
    for effect in acting:
        coefficients[effect.NAME] = (at, at + len(effect.scales))
        at += len(effect.scales)
    evidence = Evidence(systems, fit.values, base_deviations(shooting), hypotheses)
    return Mechanics(shooting, fit, evidence, coefficients, {e.NAME: e for e in acting}, around)


def effect_systems(
    shooting: Shooting,
    fit: BaseFit,
    effects: Sequence[Effect],
    around: Surroundings,
    camera: Camera | None,
    n_effects: int,
    workers: Workers = ALONE,
    *,
    motion: bool = False,
) -> list[WindowSystem]:
    """Gauss-Newton systems of all windows with the coefficients of all effects, where they are.

    Args:
        shooting: the problem.
        fit: windows, with the effects or without, and base values.
        effects: those that act through forces, then those of the camera.
        around: the whole clip.
        camera: nominal; needed with effects of the camera.
        n_effects: coefficients of all effects.
        workers: share the windows.
        motion: whether systems keep how every sub-step changes.
    """
    base = fit.base
    simulator = shooting.simulator
    if any(effect.is_active for effect in effects):
        wind = torch.from_numpy(base.wind @ shooting.horizontal)
        simulator = changed_simulation(shooting, effects, around, wind)[0]
    of_base = base_sensitivities(shooting, base, simulator.cloth.masses.numpy())
    forces = [effect for effect in effects if isinstance(effect, FORCES)]
    cameras = [effect for effect in effects if isinstance(effect, CameraEffect)]
    if cameras and camera is None:
        raise ValueError("effects of the camera need the nominal one")
    template = shooting.tracked.positions[0]
    acceleration = shooting.gravity + base.wind @ shooting.horizontal
    h = simulator.time_step
    pinned = shooting.simulator.assembly.pinned
    after = () if shooting.tension is None else (shooting.tension,)
    # A strain that is counted from the unstretched length depends on Y, as the length does.
    changing = [*(e for e in effects if isinstance(e, ElementEffect) and e.is_active), *after]
    stiffening = bool(after) and any(isinstance(e, StrainStiffening) for e in changing)

    held = around.held_times().tolist()

    def shared(window: WindowMotion) -> Callable[[StepForces], Array]:
        def sensitivities(step: StepForces) -> Array:
            time = window.first / around.fps + (step.index + 1) * h
            boundary = step.positions[pinned]
            of_frame = held[window.first + step.index // shooting.substeps]
            now = Instant(step, time, h, base.material, acceleration, boundary, after, of_frame)
            stiffer = of_base(step)
            if stiffening:
                assert shooting.tension is not None
                stiffer[0] += stretching_within(changing, now, simulator.cloth)
                stiffer[0] += shooting.tension.force(step.positions, simulator.cloth)
            return np.concatenate((stiffer, *(force_sensitivities(e, now, around) for e in forces)))

        return sensitivities

    def seen(frame: int, positions: Array) -> Array:
        found = [
            apparent_sensitivities(e, positions, template, camera) for e in cameras if camera is not None
        ]
        return np.concatenate(found) if found else np.zeros((0, *positions.shape))

    of_windows = [shared(window) for window in fit.windows]
    n_shared = n_base(shooting) + n_effects
    return window_systems(
        shooting, fit.windows, base, of_windows, seen, n_shared, simulator, workers, motion=motion
    )
