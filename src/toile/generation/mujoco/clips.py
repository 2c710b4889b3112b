"""Clips of one cloth that MuJoCo moves and our renderer films, with labels like the other generators'."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from torch import Tensor

from toile.effects.base import Scope
from toile.generation.clip_plan import ClipPlan
from toile.generation.mujoco.drawing import (
    DrawnClip,
    DrawnCloth,
    MujocoSettings,
    as_vector,
    describe,
    draw_clip,
    draw_cloth,
    pinned_corners,
    unsettled_pose,
)
from toile.generation.mujoco.effects import mujoco_effect
from toile.generation.mujoco.engine import require_mujoco, settled_pose, simulate_flex
from toile.generation.out_of_family.catalogue import scope_of
from toile.generation.out_of_family.film import (
    FilmSettings,
    Print,
    brightness_change,
    film,
    framed_camera,
    seen_pixels,
)
from toile.generation.out_of_family.interface import Measure, OutOfFamilyEffect, Reference, places_on
from toile.generation.out_of_family.making import SMALLEST_SHARES, MadeScene, size_of, strength_of
from toile.generation.out_of_family.sessions import SessionRequest
from toile.generation.textures import procedural_texture
from toile.geometry.camera import Camera
from toile.physics.simulator import SimulationError
from toile.scenes.scene import Scene

_log = logging.getLogger(__name__)

_CORRECTIONS = 2
_NEAR_ENOUGH = math.log(1.25)
"""Between a size on the simulated grid and the one asked for; beyond, the strength is corrected."""

_CLIP_ATTEMPTS = 6

_FULL_CAMERA = Camera(1400, 1400, 600, 600, 1200, 1200)
"""Generous: films are cropped to the cloth and scaled afterwards."""

# Third number of the seed of each stream.
_CLOTH, _SHAPE, _CLIP, _CLIP_SHAPE = 1, 2, 3, 4


def make_session(setup: MujocoSettings, request: SessionRequest) -> list[MadeScene]:
    """Clips of one cloth; the same request gives the same clips, bit for bit.

    Cloth, print, camera and effects of the cloth or the device are shared; winds, motions and effects of a
    clip are drawn for every clip. The cloth follows from the first clip alone, and each other clip from the
    cloth and its own plan. Labels are those of the package's own sessions.

    Raises:
        InputError: MuJoCo is missing, or the request is wrong.
        SimulationError: no cloth, or no clip, after several draws.
    """
    _check(request)
    require_mujoco()
    for attempt in range(len(SMALLEST_SHARES)):
        try:
            maker = _SessionMaker(setup, request, attempt)
            effects = maker.sized()
            first = maker.filmed(maker.first, effects, 0)
        except SimulationError as error:
            # Whoever watches a sealed set being made must not learn what is in it.
            _log.debug("session %s, draw %d: %s", request.name, attempt, error)
            continue
        return [first, *(maker.later_clip(plan, effects) for plan in request.clips[1:])]
    raise SimulationError(f"no session {request.name} after {len(SMALLEST_SHARES)} draws")


def make_spare_clip(
    setup: MujocoSettings,
    request: SessionRequest,
    plan: ClipPlan,
    attempt: int,
    strengths: Sequence[float],
) -> MadeScene:
    """One more clip of a session that has been made.

    Args:
        setup: of the session.
        request: of the session.
        plan: of the clip; its motion and place must not be those of a clip of the session.
        attempt: as the labels of the session say.
        strengths: as the labels of the session say, in the order of the effects.

    Raises:
        InputError: MuJoCo is missing, or the request is wrong.
        SimulationError: no clip after several draws.
    """
    _check(request)
    require_mujoco()
    maker = _SessionMaker(setup, request, attempt)
    effects = tuple(e.scaled(s) for e, s in zip(maker.shapes(), strengths, strict=True))
    return maker.later_clip(plan, effects)


class _SessionMaker:
    """One attempt at one session."""

    def __init__(self, setup: MujocoSettings, request: SessionRequest, attempt: int) -> None:
        self.setup, self.request, self.attempt = setup, request, attempt
        self.cloth = draw_cloth(self._rng(_CLOTH))
        self.first = self._clip(request.clips[0], 0)
        # Of the clip without effects: a spare clip needs nothing else of the others.
        camera = framed_camera(_FULL_CAMERA, self.first.twin, setup.image_side)
        self.scale = camera.fx / _FULL_CAMERA.fx

    def shapes(self) -> tuple[OutOfFamilyEffect, ...]:
        """The effects of the first clip, with a strength of 1."""
        kinds = [mujoco_effect(name) for name, _ in self.request.effects]
        return tuple(kind(self._rng(_SHAPE, k), self.first.reference) for k, kind in enumerate(kinds))

    def sized(self) -> tuple[OutOfFamilyEffect, ...]:
        """The effects with the strengths that give them their sizes in the first clip."""
        share = SMALLEST_SHARES[self.attempt]
        sizes = [size for _, size in self.request.effects]
        effects = tuple(
            self.first.of_size(e, size, share) for e, size in zip(self.shapes(), sizes, strict=True)
        )
        if len(effects) == 1 and _moves(effects[0]):
            return (self.first.corrected(effects[0], sizes[0]),)
        return effects

    def later_clip(self, plan: ClipPlan, effects: Sequence[OutOfFamilyEffect]) -> MadeScene:
        """Another clip, for effects that have their strengths; drawn until one can be made."""
        for draw in range(_CLIP_ATTEMPTS):
            try:
                clip = self._clip(plan, draw)
                there = tuple(
                    type(e)(self._rng(_CLIP_SHAPE, draw, k, *plan.stream), clip.reference).scaled(e.strength)
                    if scope_of(e.NAME) is Scope.CLIP
                    else e.moved(clip.reference)
                    for k, e in enumerate(effects)
                )
                return self.filmed(clip, there, draw)
            except SimulationError as error:
                _log.debug("clip %s of %s, draw %d: %s", plan.motion, self.request.name, draw, error)
        raise SimulationError(f"no clip {plan.motion} of {self.request.name} after {_CLIP_ATTEMPTS} draws")

    def filmed(self, clip: _Clip, effects: tuple[OutOfFamilyEffect, ...], draw: int) -> MadeScene:
        """The clip's scene with its label."""
        made = clip.filmed(effects, self.scale, self.request.name)
        session = {
            "motion": clip.plan.motion,
            "attempt": self.attempt,
            "draw": draw,
            "strengths": {e.NAME: e.strength for e in effects},
            "forms": {e.NAME: type(e).__name__ for e in effects},
        }
        levels = [f"{size:g} %" for _, size in self.request.effects]
        return replace(
            made, label={**made.label, "levels": levels, "seed": self.request.seed, "session": session}
        )

    def _clip(self, plan: ClipPlan, draw: int) -> _Clip:
        return _Clip(self.setup, self.cloth, plan, self._rng(_CLIP, draw, *plan.stream))

    def _rng(self, *stream: int) -> np.random.Generator:
        return np.random.default_rng([self.request.seed, self.attempt, *stream])


class _Clip:
    """One clip of a cloth: its start and its motion without effects, and what effects make of it."""

    def __init__(
        self, setup: MujocoSettings, cloth: DrawnCloth, plan: ClipPlan, rng: np.random.Generator
    ) -> None:
        self.setup, self.cloth, self.plan = setup, cloth, plan
        self.drawn: DrawnClip = draw_clip(plan, cloth.gravity, rng)
        self.gravity = as_vector(cloth.gravity)
        self.substeps = setup.substeps(plan.fps)
        self.width = 0.5 * (cloth.size[0] + cloth.size[1])
        self._kept: dict[tuple[tuple[str, float], ...], Tensor] = {}
        acceleration = self.gravity + as_vector(self.drawn.initial_wind)
        coarse = cloth.sheet(setup.coarse_vertices, self.drawn.turned)
        loose = unsettled_pose(cloth, self.drawn, setup.coarse_vertices)
        self.coarse_pose = settled_pose(coarse, loose, acceleration)
        fine = cloth.sheet(setup.vertices, self.drawn.turned)
        self.fine_pose = settled_pose(fine, resampled(self.coarse_pose, setup.vertices), acceleration)
        self.fine_twin = self.run((), setup.vertices)
        self.twin = self.on_fit_grid(self.fine_twin)
        self.grid_share = last_third(self.coarse_twin, self.twin, self.width)
        if self.grid_share > setup.largest_grid_share:
            raise SimulationError(f"the coarse grid strays by {self.grid_share:.2g} % without any effect")
        self.reference = Reference(
            motion=self.twin,
            cloth_size=cloth.size,
            gravity=self.gravity,
            fps=plan.fps,
            pinned=pinned_corners(setup.grid, self.drawn.turned),
        )

    @cached_property
    def coarse_twin(self) -> Tensor:
        """The clip without effects on the coarse grid, at the fit's vertices."""
        return self.on_fit_grid(self.run((), self.setup.coarse_vertices))

    def run(self, effects: Sequence[OutOfFamilyEffect], grid: tuple[int, int]) -> Tensor:
        """Every step of the clip on a grid of the engine."""
        return simulate_flex(
            self.cloth.sheet(grid, self.drawn.turned),
            self.fine_pose if grid == self.setup.vertices else self.coarse_pose,
            effects,
            pinned_motion=self.drawn.motion,
            gravity=self.gravity,
            wind=as_vector(self.drawn.wind),
            n_frames=self.plan.n_frames,
            fps=self.plan.fps,
            substeps=self.substeps,
        )

    def on_fit_grid(self, motion: Tensor) -> Tensor:
        """Frames of a motion at the material points of the fit's vertices (F, H, W, 3)."""
        return resampled(motion[:: self.substeps], self.setup.grid)

    def of_size(self, effect: OutOfFamilyEffect, size: float, smallest_share: float) -> OutOfFamilyEffect:
        """The effect with the strength at which it has a size, as far as the coarse grid tells."""
        target = size_of(type(effect), size)
        if effect.MEASURE in (Measure.EXPOSURE, Measure.EDGE, Measure.COVER):
            return effect.scaled(target / (100 if effect.MEASURE is Measure.EXPOSURE else 1))
        measured = self._measures()[effect.MEASURE]
        strength, reached = strength_of(lambda s: measured(effect.scaled(s)), target, effect.LIMIT)
        if reached < smallest_share * target:
            raise SimulationError(f"{effect.NAME} reaches {reached:.2g} of {target:.2g} % here")
        return effect.scaled(strength)

    def corrected(self, effect: OutOfFamilyEffect, target: float) -> OutOfFamilyEffect:
        """The best of a few steps towards the size where the fine grid answers otherwise."""
        tried: list[tuple[float, float]] = []  # strength, logarithm of its size over the target
        strength = effect.strength
        for _ in range(1 + _CORRECTIONS):
            try:
                motion = self.with_effects((effect.scaled(strength),))
            except SimulationError:
                break
            reached = last_third(self.on_fit_grid(motion), self.twin, self.width)
            tried.append((strength, math.log(max(reached, 1e-6) / target)))
            slope = 1.0
            if len(tried) > 1:
                (s0, v0), (s1, v1) = tried[-2:]
                slope = float(np.clip((v1 - v0) / math.log(s1 / s0), 0.5, 3.0))
            step = float(np.clip(-tried[-1][1] / slope, -0.9, 0.9))
            following = min(strength * math.exp(step), effect.LIMIT)
            if abs(tried[-1][1]) < _NEAR_ENOUGH or following == strength:
                break
            strength = following
        if not tried:
            raise SimulationError(f"{effect.NAME} cannot be simulated on the fine grid")
        return effect.scaled(min(tried, key=lambda sv: abs(sv[1]))[0])

    def with_effects(self, effects: Sequence[OutOfFamilyEffect]) -> Tensor:
        """Every step on the fine grid; results are kept."""
        key = tuple((e.NAME, e.strength) for e in effects)
        if not any(_moves(e) for e in effects):
            return self.fine_twin
        if key not in self._kept:
            self._kept[key] = self.run(effects, self.setup.vertices)
        return self._kept[key]

    def filmed(self, effects: Sequence[OutOfFamilyEffect], scale: float, name: str) -> MadeScene:
        """The scene with its label.

        Args:
            effects: that act.
            scale: of the camera.
            name: of the scene.

        Raises:
            SimulationError: it cannot be simulated, or leaves the image.
        """
        setup = self.setup
        camera = framed_camera(_FULL_CAMERA, self.twin, setup.image_side, scale)
        motion = self.with_effects(effects)
        truth = self.on_fit_grid(motion)
        self._check_in_view(seen_pixels(motion[:: self.substeps], camera, effects), camera)
        settings = FilmSettings(
            setup.supersampling, setup.blur_samples, self.cloth.blur, self.cloth.noise, self.drawn.seed
        )
        frames, masks = film(settings, camera, self._print(), motion, self.substeps, effects)
        size = torch.tensor([camera.width, camera.height], dtype=torch.float64)
        coordinates = (seen_pixels(truth[0], camera, effects) / size).clamp(0, 1)
        scene = Scene(
            name=name,
            frames=frames,
            masks=masks,
            camera=camera,
            texture=frames[0],
            texture_coordinates=coordinates.float(),
            template=truth[0],
            cloth_size=self.cloth.size,
            gravity=self.gravity,
            fps=self.plan.fps,
            pinned_vertices=self.reference.pinned,
            original_size=(camera.height, camera.width),
        )
        return MadeScene(scene, self._label(effects, truth), truth, self.twin)

    def _measures(self) -> Mapping[Measure, Callable[[OutOfFamilyEffect], float]]:
        return {
            Measure.MOTION: self._coarse_gap,
            Measure.PIXELS: self._pixel_gap,
            Measure.BRIGHTNESS: lambda e: brightness_change(e, self.twin),
        }

    def _coarse_gap(self, effect: OutOfFamilyEffect) -> float:
        motion = self.on_fit_grid(self.run((effect,), self.setup.coarse_vertices))
        return last_third(motion, self.coarse_twin, self.width)

    def _pixel_gap(self, effect: OutOfFamilyEffect) -> float:
        """Mean displacement in the image [% of the cloth's width in it]."""
        camera = framed_camera(_FULL_CAMERA, self.twin, self.setup.image_side)
        plain = camera.project(self.twin)
        width = float((plain[0, -1] - plain[0, 0]).norm(dim=-1).mean())
        seen = seen_pixels(self.twin, camera, (effect,))
        return 100 * float((seen - plain).norm(dim=-1).mean()) / width

    def _print(self) -> Print:
        side = self.setup.texture_side
        u, v = (torch.linspace(0, 1, n, dtype=torch.float32) for n in self.setup.vertices)
        coordinates = torch.stack(torch.meshgrid(u, v, indexing="ij"), -1)
        return Print(procedural_texture(side, side, self.cloth.texture_seed), coordinates)

    def _check_in_view(self, pixels: Tensor, camera: Camera) -> None:
        size = pixels.new_tensor([camera.width, camera.height])
        outside = ((pixels < 0) | (pixels > size)).any(-1).double()
        if float(outside.mean((1, 2)).max()) > 0.03:
            raise SimulationError("the cloth leaves the image")

    def _label(self, effects: Sequence[OutOfFamilyEffect], truth: Tensor) -> dict[str, Any]:
        """The label with the keys and units of the package's out-of-family generator."""
        distance = 100 * (truth - self.twin).norm(dim=-1) / self.width
        times = torch.arange(self.plan.n_frames, dtype=torch.float64) / self.plan.fps
        vertices = _joined([e.where(places_on(self.setup.grid)) for e in effects])
        frames = _joined([e.when(times) for e in effects])
        names = [e.NAME for e in effects]
        gap = last_third(truth, self.twin, self.width)
        return {
            "effect": "+".join(names) or "none",
            "effects": names,
            "stage": effects[0].STAGE.value if effects else "none",
            "stage_accept": sorted({s.value for e in effects for s in (e.STAGE, *e.ACCEPTED)}) or ["none"],
            "in_catalogue": not any(e.OUTSIDE for e in effects),
            "parameters": {e.NAME: e.parameters() for e in effects},
            "comparable": {e.NAME: e.comparable() for e in effects},
            "magnitude": {
                "mean_last_third": gap,
                "max_last_third": float(distance[len(distance) * 2 // 3 :].max()),
                "per_frame_mean": distance.mean((1, 2)).tolist(),
                "unit": "% of the cloth's width",
                "alone": {e.NAME: self._alone(e, gap if len(effects) == 1 else None) for e in effects},
            },
            "localisation": {
                "vertices": None if vertices is None else vertices.nonzero().flatten().tolist(),
                "frames": None if frames is None else frames.nonzero().flatten().tolist(),
            },
            "grid_share": self.grid_share,
            "base": describe(self.cloth, self.drawn),
            "generator": "mujoco",
        }

    def _alone(self, effect: OutOfFamilyEffect, gap: float | None) -> dict[str, Any]:
        """Size of one effect in what its strength is named in; of two in motion, each on the coarse grid."""
        if effect.MEASURE is Measure.MOTION:
            value = self._coarse_gap(effect) if gap is None else gap
        elif effect.MEASURE in (Measure.PIXELS, Measure.BRIGHTNESS):
            value = self._measures()[effect.MEASURE](effect)
        else:
            value = effect.strength * (100 if effect.MEASURE is Measure.EXPOSURE else 1)
        return {"value": value, "measure": effect.MEASURE.name.lower()}


def resampled(values: Tensor, grid: tuple[int, int]) -> Tensor:
    """Values (..., H, W, C) at the material points of another grid's vertices, by bicubic splines."""
    result = values
    for axis, n in ((-3, grid[0]), (-2, grid[1])):
        old = values.shape[axis]
        if old != n:
            weights = CubicSpline(np.arange(old), np.eye(old))(np.linspace(0, old - 1, n))
            moved = torch.from_numpy(weights) @ result.transpose(axis, -2)
            result = moved.transpose(axis, -2)
    return result


def last_third(motion: Tensor, twin: Tensor, width: float) -> float:
    """Mean distance of two motions (F, H, W, 3) in the last third [% of the width]."""
    begin = len(motion) * 2 // 3
    return 100 * float((motion - twin)[begin:].norm(dim=-1).mean()) / width


def _moves(effect: OutOfFamilyEffect) -> bool:
    return effect.MEASURE is Measure.MOTION


def _joined(masks: Sequence[Tensor | None]) -> Tensor | None:
    """Where any acts; None where one acts everywhere, or none acts."""
    if not masks or any(m is None for m in masks):
        return None
    return torch.stack([m for m in masks if m is not None]).any(0)


def _check(request: SessionRequest) -> None:
    """Raise InputError for an effect or a size that is none."""
    for name, size in request.effects:
        size_of(mujoco_effect(name), size)
