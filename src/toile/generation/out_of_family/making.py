"""One scene of the out-of-family generator: motion with and without its effects, film, label."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from toile.errors import InputError
from toile.generation.initial_pose import hanging_sheet
from toile.generation.out_of_family.base_scene import BaseScene, OutOfFamilySettings, draw_base
from toile.generation.out_of_family.catalogue import LEVELS, out_of_family_effect
from toile.generation.out_of_family.film import (
    FilmSettings,
    Print,
    brightness_change,
    film,
    framed_camera,
    seen_pixels,
)
from toile.generation.out_of_family.interface import Measure, OutOfFamilyEffect, Reference, places_on
from toile.generation.out_of_family.simulation import simulate_out_of_family
from toile.generation.refinement import coarsen, refine, refined_size
from toile.generation.simulation import Sheet
from toile.generation.starting_point import StartingPoint, settled_sheet, starting_point
from toile.geometry.camera import Camera
from toile.physics.simulator import SimulationError
from toile.scenes.scene import Scene

_log = logging.getLogger(__name__)

SIZES = (1.0, 3.0, 7.0)
"""Of effects in sessions: small, medium and large [% of the width in the last third of the first clip]."""

SMALLEST_SHARES = (0.6,) * 4 + (0.3,) * 4 + (0.1,) * 16
"""Of the gap that was asked for, by attempt; with less, another scene is drawn. Labels tell the true size."""

_NEAR_ENOUGH = math.log(1.4)
"""Between a gap on the simulated grid and the one asked for."""


@dataclass(frozen=True)
class SceneRequest:
    """What one scene shall be.

    Attributes:
        name: opaque.
        effects: (name, size) pairs, see ``size_of``; () for a scene without any effect.
        seed: of everything random.
    """

    name: str
    effects: tuple[tuple[str, str | float], ...]
    seed: int


@dataclass(frozen=True)
class MadeScene:
    """A scene and what must be kept from those who diagnose it.

    Attributes:
        scene: without ground truth.
        label: JSON values.
        vertices: the truth (F, H, W, 3) [m], float64.
        twin: the same clip without its effects, (F, H, W, 3) [m].
    """

    scene: Scene
    label: dict[str, Any]
    vertices: Tensor
    twin: Tensor


def make_scene(setup: OutOfFamilySettings, request: SceneRequest) -> MadeScene:
    """Make one scene; the same settings and request give the same scene, bit for bit.

    The base scene (material, wind, motion of the corners, print, camera, noise) is drawn from a stream of its
    own, whatever the effects. Where a base cannot be simulated, or allows no gap of the size asked for, the
    next one is drawn.

    Raises:
        InputError: an unknown effect or level, or data that are not there.
        SimulationError: no scene after several draws.
    """
    for name, level in request.effects:
        size_of(out_of_family_effect(name), level)
    for attempt in range(len(SMALLEST_SHARES)):
        base = draw_base(setup, np.random.default_rng([request.seed, attempt, 1]))
        try:
            return ClipMaker(setup, base, request, attempt).make()
        except SimulationError as error:
            # Whoever watches a blind set being made must not learn what is in it.
            _log.debug("scene %s, draw %d: %s", request.name, attempt, error)
    raise SimulationError(f"no scene {request.name} after {len(SMALLEST_SHARES)} draws")


class ClipMaker:
    """One attempt at one clip.

    Args:
        setup: of the set.
        base: of the clip.
        request: what it shall be; a size may be a level, or a number, see ``size_of``.
        attempt: number of the draw.

    Attributes:
        reference: the clip without effects, which shapes are drawn for.

    Raises:
        SimulationError: the clip without effects cannot be simulated.
    """

    def __init__(
        self, setup: OutOfFamilySettings, base: BaseScene, request: SceneRequest, attempt: int
    ) -> None:
        self.setup, self.base, self.request = setup, base, request
        self.settings = base.settings
        self.attempt = attempt
        self.rng = np.random.default_rng([request.seed, attempt, 2])
        self.start: StartingPoint = start_of(base)
        self.fine = settled_sheet(self.settings, self.start, base.law)
        pose = coarsen(self.fine.pose, self.settings.refinement)
        self.coarse = Sheet.of(
            pose,
            self.start.cloth_size,
            self.settings.areal_density,
            self.start.pinned,
            self.settings.material(self.start.cloth_size),
            base.law,
        )
        self.coarse_twin = self.run(self.coarse, (), setup.coarse_substeps)[:: setup.coarse_substeps]
        self.reference = Reference(
            motion=self.coarse_twin,
            cloth_size=self.start.cloth_size,
            gravity=torch.tensor(self.settings.gravity, dtype=torch.float64),
            fps=self.settings.fps,
            pinned=self.start.pinned,
        )

    def run(self, sheet: Sheet, effects: Sequence[OutOfFamilyEffect], substeps: int) -> Tensor:
        """Simulate; every sub-step."""
        s = self.settings
        return simulate_out_of_family(
            sheet,
            effects,
            pinned_motion=s.pinned_motion,
            gravity=torch.tensor(s.gravity, dtype=torch.float64),
            wind=torch.tensor(s.wind, dtype=torch.float64),
            n_frames=s.n_frames,
            fps=s.fps,
            substeps=substeps,
            newton=s.newton,
        )

    def make(self) -> MadeScene:
        """The scene.

        Raises:
            SimulationError: it cannot be simulated, or no strength makes the gap that was asked for.
        """
        twin = self.twin()
        effects = tuple(self._of_level(name, level) for name, level in self.request.effects)
        effects, motion = self.sized(effects, twin)
        return self.filmed(effects, motion, twin)

    def twin(self) -> Tensor:
        """Every sub-step of the clip without effects, on the simulated grid (T, H', W', 3) [m].

        Raises:
            SimulationError: the fit's grid strays from it, or it cannot be simulated.
        """
        settings = self.settings
        fine_twin = self.run(self.fine, (), settings.substeps)
        share = _last_third(
            coarsen(fine_twin[:: settings.substeps], settings.refinement),
            self.coarse_twin,
            self.reference.width,
        )
        if share > self.setup.largest_grid_share:
            raise SimulationError(f"the fit's grid strays by {share:.2g} % without any effect")
        return fine_twin

    def moved(self, effects: tuple[OutOfFamilyEffect, ...], twin: Tensor) -> Tensor:
        """Every sub-step of the clip with its effects; the twin itself where none moves the cloth."""
        if not any(_moves(e) for e in effects):
            return twin
        return self.run(self.fine, effects, self.settings.substeps)

    def sized(
        self, effects: tuple[OutOfFamilyEffect, ...], twin: Tensor
    ) -> tuple[tuple[OutOfFamilyEffect, ...], Tensor]:
        """The motion with effects that have their strength on the fit's grid, corrected on the fine one."""
        motion = self.moved(effects, twin)
        if len(effects) == 1 and _moves(effects[0]):
            return self._corrected(effects[0], motion, twin)
        return effects, motion

    def filmed(
        self,
        effects: tuple[OutOfFamilyEffect, ...],
        motion: Tensor,
        fine_twin: Tensor,
        scale: float | None = None,
    ) -> MadeScene:
        """The scene with its label.

        Args:
            effects: that act.
            motion: every sub-step (T, H', W', 3) [m].
            fine_twin: the same without the effects.
            scale: of the camera; None for one by the size of the image.

        Raises:
            SimulationError: the cloth leaves the image.
        """
        setup, settings = self.setup, self.settings
        factor = settings.refinement
        truth = coarsen(motion[:: settings.substeps], factor)
        twin = coarsen(fine_twin[:: settings.substeps], factor)
        camera = framed_camera(self.start.camera, twin, setup.image_side, scale)
        self._check_in_view(seen_pixels(motion[:: settings.substeps], camera, effects), camera)
        frames, masks = film(
            FilmSettings(
                settings.supersampling, setup.blur_samples, settings.blur, settings.noise, settings.seed
            ),
            camera,
            self._print(),
            motion,
            settings.substeps,
            effects,
        )
        size = torch.tensor([camera.width, camera.height], dtype=torch.float64)
        coordinates = (seen_pixels(truth[0], camera, effects) / size).clamp(0, 1)
        scene = Scene(
            name=self.request.name,
            frames=frames,
            masks=masks,
            camera=camera,
            texture=frames[0],
            texture_coordinates=coordinates.float(),
            template=truth[0],
            cloth_size=self.start.cloth_size,
            gravity=torch.tensor(settings.gravity, dtype=torch.float64),
            fps=settings.fps,
            pinned_vertices=self.start.pinned,
            original_size=(camera.height, camera.width),
        )
        return MadeScene(scene, self._label(effects, truth, twin), truth, twin)

    def _of_level(self, name: str, level: str | float) -> OutOfFamilyEffect:
        """An effect with the strength at which it is as large as the level says."""
        return self.of_size(out_of_family_effect(name)(self.rng, self.reference), level)

    def of_size(self, effect: OutOfFamilyEffect, size: str | float) -> OutOfFamilyEffect:
        """The shape with the strength at which it is as large as asked for, on the fit's grid.

        Args:
            effect: a shape.
            size: see ``size_of``.

        Raises:
            SimulationError: no strength makes it so large.
        """
        kind = type(effect)
        target = size_of(kind, size)
        if kind.MEASURE in (Measure.EXPOSURE, Measure.EDGE, Measure.COVER):
            return effect.scaled(target / (100 if kind.MEASURE is Measure.EXPOSURE else 1))
        measured: Callable[[OutOfFamilyEffect], float] = {
            Measure.MOTION: self._motion_gap,
            Measure.PIXELS: self._pixel_gap,
            Measure.BRIGHTNESS: lambda e: brightness_change(e, self.coarse_twin),
        }[kind.MEASURE]
        found, reached = strength_of(lambda s: measured(effect.scaled(s)), target, kind.LIMIT)
        if reached < SMALLEST_SHARES[self.attempt] * target:
            raise SimulationError(f"{kind.NAME} reaches {reached:.2g} of {target:.2g} % here")
        return effect.scaled(found)

    def _corrected(
        self, effect: OutOfFamilyEffect, motion: Tensor, twin: Tensor
    ) -> tuple[tuple[OutOfFamilyEffect, ...], Tensor]:
        """One more step towards the level, where the fine grid answers otherwise than the fit's."""
        substeps, width = self.settings.substeps, self.reference.width
        target = size_of(type(effect), self.request.effects[0][1])
        reached = _last_third(motion[::substeps], twin[::substeps], width)
        ratio = float(np.clip(target / max(reached, 1e-6), 0.4, 2.5))
        strength = min(effect.strength * ratio, effect.LIMIT)
        if abs(math.log(ratio)) < _NEAR_ENOUGH or strength == effect.strength:
            return (effect,), motion
        other = effect.scaled(strength)
        try:
            other_motion = self.run(self.fine, (other,), substeps)
        except SimulationError:
            return (effect,), motion
        other_reached = _last_third(other_motion[::substeps], twin[::substeps], width)
        if abs(math.log(max(other_reached, 1e-6) / target)) < abs(math.log(max(reached, 1e-6) / target)):
            return (other,), other_motion
        return (effect,), motion

    def _motion_gap(self, effect: OutOfFamilyEffect) -> float:
        """Mean displacement against the twin in the last third, on the fit's grid [% of the width]."""
        steps = self.setup.coarse_substeps
        motion = self.run(self.coarse, (effect,), steps)[::steps]
        return _last_third(motion, self.coarse_twin, self.reference.width)

    def _pixel_gap(self, effect: OutOfFamilyEffect) -> float:
        """Mean displacement in the image [% of the cloth's width in it]."""
        camera = framed_camera(self.start.camera, self.coarse_twin, self.setup.image_side)
        plain = camera.project(self.coarse_twin)
        width = float((plain[0, -1] - plain[0, 0]).norm(dim=-1).mean())
        seen = seen_pixels(self.coarse_twin, camera, (effect,))
        return 100 * float((seen - plain).norm(dim=-1).mean()) / width

    def _print(self) -> Print:
        """Texture and coordinates on the simulated grid."""
        if self.base.template is not None:
            t = self.base.template
            return Print(t.texture, refine(t.texture_coordinates, self.settings.refinement))
        assert self.base.texture is not None
        u, v = (
            torch.linspace(0, 1, n, dtype=torch.float32)
            for n in refined_size(self.settings.grid, self.settings.refinement)
        )
        return Print(self.base.texture, torch.stack(torch.meshgrid(u, v, indexing="ij"), -1))

    def _check_in_view(self, pixels: Tensor, camera: Camera) -> None:
        """Raise SimulationError where more than a little of the cloth leaves the image."""
        size = pixels.new_tensor([camera.width, camera.height])
        outside = ((pixels < 0) | (pixels > size)).any(-1).double()
        if float(outside.mean((1, 2)).max()) > 0.03:
            raise SimulationError("the cloth leaves the image")

    def _label(self, effects: Sequence[OutOfFamilyEffect], truth: Tensor, twin: Tensor) -> dict[str, Any]:
        width = self.reference.width
        distance = 100 * (truth - twin).norm(dim=-1) / width
        places = places_on(self.settings.grid)
        times = torch.arange(self.settings.n_frames, dtype=torch.float64) / self.settings.fps
        vertices = _joined([e.where(places) for e in effects])
        frames = _joined([e.when(times) for e in effects])
        names = [e.NAME for e in effects]
        gap = _last_third(truth, twin, width)
        grid_share = _last_third(self.coarse_twin, twin, width)
        return {
            "effect": "+".join(names) or "none",
            "effects": names,
            "levels": [s if isinstance(s, str) else f"{s:g} %" for _, s in self.request.effects],
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
            "grid_share": grid_share,
            "base": self.base.describe(),
            "generator": "toile",
            "seed": self.request.seed,
        }

    def _alone(self, effect: OutOfFamilyEffect, gap: float | None) -> dict[str, Any]:
        """Size of one effect in what its strength is named in; of two in motion, each on the fit's grid."""
        match effect.MEASURE:
            case Measure.MOTION:
                value = self._motion_gap(effect) if gap is None else gap
            case Measure.PIXELS:
                value = self._pixel_gap(effect)
            case Measure.BRIGHTNESS:
                value = brightness_change(effect, self.coarse_twin)
            case _:
                value = effect.strength * (100 if effect.MEASURE is Measure.EXPOSURE else 1)
        return {"value": value, "measure": effect.MEASURE.name.lower()}


def size_of(kind: type[OutOfFamilyEffect], size: str | float) -> float:
    """How large an effect shall be, in what its strength is named in.

    Args:
        kind: of the effect.
        size: one of LEVELS, or a size in the motion [% of the width]. An effect that does not move the cloth
            is made as large, by its own levels, as 1, 3 and 7 % are for one that does.

    Raises:
        InputError: no such level, or a size that is not above 0.
    """
    if isinstance(size, str):
        if size not in LEVELS:
            raise InputError("No such level", where="effects", expected=", ".join(LEVELS), got=size)
        return kind.LEVELS[LEVELS.index(size)]
    if not (math.isfinite(size) and size > 0):
        raise InputError("No such size", where="effects", expected="a number above 0 [%]", got=str(size))
    if kind.MEASURE is Measure.MOTION:
        return float(size)
    return float(np.exp(np.interp(math.log(size), np.log(SIZES), np.log(kind.LEVELS))))


def strength_of(
    size: Callable[[float], float], target: float, limit: float, *, tolerance: float = 0.15, tries: int = 5
) -> tuple[float, float]:
    """Strength at which an effect has a given size, by secants in logarithms.

    Args:
        size: of the effect by strength; a strength that cannot be simulated counts as too large.
        target: size to reach.
        limit: largest strength.
        tolerance: relative error that is good enough.
        tries: evaluations at most.

    Returns:
        Strength and its size: the closest of those tried.
    """
    tried: list[tuple[float, float]] = []
    strength, ceiling = min(1.0, 0.5 * limit), limit
    for _ in range(tries):
        try:
            value = size(strength)
        except SimulationError:
            ceiling = 0.7 * strength
            strength *= 0.5
            continue
        if not math.isfinite(value) or value <= 0:
            value = 1e-6
        tried.append((strength, value))
        if abs(value / target - 1) <= tolerance:
            break
        slope = 1.0
        if len(tried) > 1:
            (s0, v0), (s1, v1) = tried[-2:]
            if s0 != s1 and v0 != v1:
                slope = float(np.clip(math.log(v1 / v0) / math.log(s1 / s0), 0.5, 3.0))
        step = float(np.clip((target / value) ** (1 / slope), 1 / 8, 8))
        following = min(strength * step, ceiling)
        if following == strength:
            break
        strength = following
    if not tried:
        raise SimulationError("an effect cannot be simulated at any strength")
    return min(tried, key=lambda sv: abs(math.log(sv[1] / target)))


def start_of(base: BaseScene) -> StartingPoint:
    """Where the clip begins, before the cloth has settled."""
    start = starting_point(base.settings, base.template)
    if not base.turned:
        return start
    # Procedural whatever the template: nobody has filmed it the other way round.
    s = base.settings
    H, W = s.grid
    across, down = start.cloth_size
    upright = hanging_sheet(
        (W, H),
        (down, across),
        pinned_distance=s.pinned_distance,
        distance=float(start.pose[..., 2].mean()),
        yaw=math.radians(s.yaw),
        gravity=s.gravity,
        seed=s.seed,
    )
    # A quarter turn, not a reflection: axis 0 runs down now, axis 1 to the left.
    return replace(start, pose=upright.flip(0).transpose(0, 1).contiguous(), pinned=(0, W - 1))


def _moves(effect: OutOfFamilyEffect) -> bool:
    return effect.MEASURE is Measure.MOTION


def _last_third(motion: Tensor, twin: Tensor, width: float) -> float:
    """Mean distance of two motions (F, H, W, 3) in the last third [% of the width]."""
    begin = len(motion) * 2 // 3
    return 100 * float((motion - twin)[begin:].norm(dim=-1).mean()) / width


def _joined(masks: Sequence[Tensor | None]) -> Tensor | None:
    """Where any acts; None where one acts everywhere, or none acts."""
    if not masks or any(m is None for m in masks):
        return None
    return torch.stack([m for m in masks if m is not None]).any(0)


def development_scene(
    effect: str, level: str = "medium", seed: int = 0, setup: OutOfFamilySettings | None = None
) -> MadeScene:
    """A scene of one effect ("none" for none), for development."""
    effects = () if effect == "none" else ((effect, level),)
    setup = setup or OutOfFamilySettings(templates=())
    return make_scene(setup, SceneRequest(f"{effect}_{level}_{seed}", effects, seed))
