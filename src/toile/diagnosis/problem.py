"""What a diagnosis works on: a clip, its candidates, and the models around what stages have found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from functools import cache

import numpy as np
import torch
from numpy.typing import NDArray

from toile.diagnosis.fingerprint import code_fingerprint, fingerprint
from toile.diagnosis.mechanics import Mechanics, mechanics_around, shooting_of, surroundings
from toile.diagnosis.model_grid import ModelGrid, model_grids
from toile.diagnosis.numerics import halved
from toile.diagnosis.results import BaseModel, ConvergedBase, Seen, TrackedMotion
from toile.diagnosis.settings import DiagnosisSettings
from toile.diagnosis.shooting import Shooting
from toile.diagnosis.tracked import Tracked, point_settings, tracked_motion
from toile.effects.base import Effect
from toile.errors import InputError
from toile.physics.implicit.integrators import BDF2
from toile.physics.implicit.simulator import ImplicitSimulator
from toile.reconstruction.gauss_newton.recipe import TrackingRecipe
from toile.reconstruction.image_terms.texture_points import TexturePointTerm
from toile.reconstruction.problem import Reconstruction
from toile.scenes.scene import Scene

Array = NDArray[np.float64]

# What of a scene a diagnosis looks at: everything but what it is called, where it lies, and the truth.
_SEEN = [f.name for f in fields(Scene) if f.name not in ("name", "source", "notes", "ground_truth")]


class DiagnosisProblem:
    """One clip to diagnose. Models around stored results are large: they are made anew, once each.

    Args:
        reconstruction: the scene with its cloth and free forces; its parameters are changed in place.
        recipe: tracks the motion; its last stage is used.
        effects: candidates, at zero.
        settings: see DiagnosisSettings.

    Attributes:
        n_fitted: frames that are meant to be fitted.
        image_term: () of the last stage of tracking; the features of its images take seconds.
        levels: (tracked) grids of the model, coarse to fine, and the motion on them.
        mechanics: (tracked, base) the base model with the problem that it solves.
        converged_mechanics: (tracked, base, converged) the same around the converged base model.
        made_from: fingerprints of what every stage depends on, by name.
        candidates: the fingerprint of the effects, for stages that depend on them.

    Raises:
        InputError: see check_problem.
    """

    def __init__(
        self,
        reconstruction: Reconstruction,
        recipe: TrackingRecipe,
        effects: Sequence[Effect],
        settings: DiagnosisSettings,
    ) -> None:
        check_problem(reconstruction, effects, settings)
        self.reconstruction, self.scene = reconstruction, reconstruction.scene
        self.recipe, self.effects, self.settings = recipe, tuple(effects), settings
        self.n_fitted = fitted_frames(self.scene, settings.held_out, settings.fewest_frames)
        _start_material(reconstruction, settings.stiffness)
        self.made_from = _fingerprints(reconstruction, recipe)
        self.candidates = {"candidates": fingerprint(self.effects)}
        self.image_term = cache(self._image_term)
        self.levels = cache(self._levels)
        self.mechanics = cache(self._mechanics)
        self.converged_mechanics = cache(self._converged_mechanics)
        self._shooting = cache(self._new_shooting)
        self._images: tuple[Array, Array, Tracked] | None = None

    def n_used(self, seen: Seen) -> int:
        """Frames that are fitted: as many as are meant to be, as long as tracking keeps the cloth."""
        return min(self.n_fitted, seen.known)

    def _image_term(self) -> TexturePointTerm:
        return TexturePointTerm.of(self.reconstruction, point_settings(self.recipe), self.settings.seed)

    def images_around(self, positions: Array, grid: ModelGrid) -> Tracked:
        """The image term around a motion; that around the last one asked for is kept.

        Args:
            positions: on the scene's grid (F, N, 3) [m].
            grid: of the model.
        """
        kept = self._images
        if kept is None or not (
            kept[0].shape == positions.shape
            and np.array_equal(kept[0], positions)
            and np.array_equal(kept[1], grid.prolong)
        ):
            found = tracked_motion(self.reconstruction, positions, grid, self.image_term())
            self._images = kept = (positions.copy(), grid.prolong, found)
        return kept[2]

    def _levels(self, tracked: TrackedMotion) -> list[tuple[ModelGrid, Tracked]]:
        return [
            (grid, tracked_motion(self.reconstruction, tracked.positions, grid, self.image_term()))
            for grid in model_grids(self.scene, self.reconstruction.cloth, self.settings.sides)
        ]

    def _mechanics(self, tracked: TrackedMotion, base: BaseModel) -> Mechanics:
        return self._around(tracked, base.halvings, base)

    def _converged_mechanics(
        self, tracked: TrackedMotion, base: BaseModel, converged: ConvergedBase
    ) -> Mechanics:
        return self._around(tracked, base.halvings, converged)

    def _around(self, tracked: TrackedMotion, halvings: int, found: BaseModel | ConvergedBase) -> Mechanics:
        return mechanics_around(
            self._shooting(tracked, halvings),
            found.fit,
            found.systems,
            self.effects,
            surroundings(self.scene, self.levels(tracked)[-1][0]),
            self.settings.evidence,
        )

    def _new_shooting(self, tracked: TrackedMotion, halvings: int) -> Shooting:
        settings = self.settings
        grid, motion = self.levels(tracked)[-1]
        shooting = shooting_of(self.scene, grid, motion, settings.shooting, settings.longest_substep)
        for _ in range(halvings):
            shooting = halved(shooting)
        return shooting


def fitted_frames(scene: Scene, held_out: float, fewest: int) -> int:
    """Frames that are fitted; those after them are held out.

    Args:
        scene: the clip.
        held_out: share of them.
        fewest: that are fitted at least.

    Raises:
        InputError: the clip is too short for both.
    """

    def fitted(n: int) -> int:
        return n - round(held_out * n)

    n_frames = scene.n_frames
    if fitted(n_frames) < fewest:
        enough = n_frames + 1
        while fitted(enough) < fewest:
            enough += 1
        beside = f": {fewest} to fit, and a share of {held_out:g} held out (diagnosis.held_out)"
        raise InputError(
            "The clip is too short for a diagnosis",
            where=f"scene {scene.name}",
            expected=f"{enough} frames or more{beside if held_out else ''}",
            got=f"{n_frames} frames",
        )
    return fitted(n_frames)


def check_problem(
    reconstruction: Reconstruction, effects: Sequence[Effect], settings: DiagnosisSettings
) -> None:
    """Refuse what a diagnosis cannot do, or would otherwise pass over in silence.

    Raises:
        InputError: unevenly spaced frames, too few of them, another simulator than the base model has,
            effects that act while the motion is tracked, no candidates, or candidates that are not at zero.
    """
    _require_even_spacing(reconstruction.scene)
    fitted_frames(reconstruction.scene, settings.held_out, settings.fewest_frames)
    simulator = reconstruction.simulator
    if type(simulator) is not ImplicitSimulator or not isinstance(simulator.integrator, BDF2):
        of = type(simulator.integrator).__name__ if isinstance(simulator, ImplicitSimulator) else ""
        raise InputError(
            "A diagnosis has one simulator, and effects are judged by its exact derivatives",
            where="simulator",
            expected="simulator=implicit with simulator/integrator=bdf2",
            got=" with ".join(filter(None, (type(simulator).__name__, of))),
        )
    if len(reconstruction.effects):
        raise InputError(
            "A diagnosis tracks the motion without effects: free forces stand for all of them",
            where="effect",
            expected="none; candidates are given by effect@candidates",
            got=", ".join(effect.NAME for effect in reconstruction.effects.acting()),
        )
    if not effects:
        raise InputError(
            "There is nothing to choose from",
            where="candidates",
            expected="an effect or more, e.g. effect@candidates=[air_drag,gusts]",
            got="none",
        )
    for effect in effects:
        if not effect.is_identity:
            values = zip(effect.parameters, effect.values.tolist(), strict=True)
            raise InputError(
                "Candidates start from zero: the question is whether they act at all",
                where=f"candidates.{effect.NAME}.values",
                expected="0 for every one; the diagnosis estimates them",
                got=", ".join(f"{p.name}: {value:g}" for p, value in values if value),
            )


def _require_even_spacing(scene: Scene) -> None:
    # Windows, ramps, effect sensitivities and the held-out end all count frames as time.
    if scene.times is None:
        return
    intervals = 1e3 * scene.times.diff()
    raise InputError(
        "A diagnosis needs evenly spaced frames",
        where=str(scene.source or scene.name),
        expected="one frame rate; 'toile masks ... times=uniform' chooses such frames from the clip, then "
        "'toile template' again",
        got=f"intervals of {float(intervals.min()):.4g} to {float(intervals.max()):.4g} ms",
    )


def _fingerprints(reconstruction: Reconstruction, recipe: TrackingRecipe) -> Mapping[str, str]:
    scene, simulator = reconstruction.scene, reconstruction.simulator
    assert isinstance(simulator, ImplicitSimulator)
    renderer = reconstruction.renderer
    return {
        "code": code_fingerprint(),
        "scene": fingerprint({name: getattr(scene, name) for name in _SEEN}),
        "cloth": fingerprint(reconstruction.cloth),
        "simulator": fingerprint(simulator.newton, simulator.integrator, reconstruction.frame_steps),
        "renderer": fingerprint(type(renderer), getattr(renderer, "supersampling", None)),
        "optimization": fingerprint(recipe.stages[-1]),
        "start": fingerprint(reconstruction.parameters.state_dict()),
    }


def _start_material(reconstruction: Reconstruction, stiffness: tuple[float, float, float]) -> None:
    """Track with the same fabric whatever the scene's grid."""
    p = reconstruction.parameters
    cell = p.units.length**2
    values = torch.tensor([stiffness[0], stiffness[1] * cell, stiffness[2]], dtype=torch.float64)
    p.set_stiffness((values / p.stiffness_units).tolist())
