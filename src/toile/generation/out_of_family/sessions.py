"""Sessions of the out-of-family generator: several clips of one cloth.

All clips share material, size, density, law of the cloth, print, camera and gravity, and every effect of the
cloth or of the device with its shape and strength. Wind, motion of the corners, first pose, noise, and
effects that belong to a clip (gusts, slips, obstacles; their strength is the same) are drawn anew for each.
Nulls vary as much: the law (angles, or taut with random ratios), the length of the steps, and the functional
form of every effect are drawn for each session.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from torch import Tensor

from toile.effects.base import Scope
from toile.generation.clip_plan import DEFAULT_CLIPS, ClipPlan
from toile.generation.out_of_family.base_scene import (
    BaseScene,
    OutOfFamilySettings,
    draw_base,
    draw_motion,
    draw_winds,
)
from toile.generation.out_of_family.catalogue import forms_of, scope_of
from toile.generation.out_of_family.film import framed_camera
from toile.generation.out_of_family.interface import OutOfFamilyEffect
from toile.generation.out_of_family.making import (
    SMALLEST_SHARES,
    ClipMaker,
    MadeScene,
    SceneRequest,
    size_of,
)
from toile.physics.simulator import SimulationError

_log = logging.getLogger(__name__)

_WINDS = {
    "hang": ((0.3, 1.2), (0.8, 2.4)),
    "release": ((1.2, 2.8), (0.0, 0.0)),
    "shake": ((0.0, 0.8), (0.2, 1.2)),
    "sway": ((0.0, 0.8), (0.2, 1.2)),
    "turned": ((0.0, 0.8), (0.2, 1.2)),
    "fan_off": ((0.0, 0.0), (0.0, 0.0)),
}
"""Strengths until frame 0 and from it on [m/s²], by motion."""

_CORNERS = {"hang": 0, "release": 0, "shake": 1, "sway": 2, "turned": 1, "fan_off": 1}
"""What the corners do, by motion; see draw_motion."""

# Last number of the seed of each stream: 1 and 2 are those of single scenes.
_BASE, _SHAPE, _CLIP, _CLIP_SHAPE, _VARIETY = 1, 2, 3, 4, 5


@dataclass(frozen=True)
class SessionRequest:
    """What one session shall be.

    Attributes:
        name: opaque.
        effects: (name, size) pairs, size as ``making.size_of`` takes it, in the first clip; () for none.
        seed: of everything random.
        clips: one or more.
    """

    name: str
    effects: tuple[tuple[str, float], ...]
    seed: int
    clips: tuple[ClipPlan, ...] = DEFAULT_CLIPS


def make_session(setup: OutOfFamilySettings, request: SessionRequest) -> list[MadeScene]:
    """The clips of a session, in order; the same settings and request give the same session, bit for bit.

    Labels are those of single scenes, with ``session``: {``motion``, ``attempt``, ``strengths`` by effect}.

    Raises:
        InputError: an unknown effect, a size that is none, or data that are not there.
        SimulationError: no session after several draws.
    """
    _check(request)
    for attempt in range(len(SMALLEST_SHARES)):
        try:
            return _SessionMaker(setup, request, attempt).made()
        except SimulationError as error:
            # Whoever watches a blind set being made must not learn what is in it.
            _log.debug("session %s, draw %d: %s", request.name, attempt, error)
    raise SimulationError(f"no session {request.name} after {len(SMALLEST_SHARES)} draws")


def make_spare_clip(
    setup: OutOfFamilySettings,
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
        SimulationError: the clip cannot be simulated.
    """
    _check(request)
    maker = _SessionMaker(setup, request, attempt)
    effects = tuple(e.scaled(s) for e, s in zip(maker.shapes(), strengths, strict=True))
    return maker.later_clip(plan, effects)


class _SessionMaker:
    """One attempt at one session."""

    def __init__(self, setup: OutOfFamilySettings, request: SessionRequest, attempt: int) -> None:
        self.setup, self.request, self.attempt = setup, request, attempt
        rng = self._rng(_VARIETY)
        taut, ratios = rng.random() < 0.5, (float(rng.uniform(0.2, 1.0)), float(rng.uniform(0.0, 0.6)))
        self.compression = ratios if taut else None
        self.more_substeps = int(rng.integers(-1, 2))
        kinds = [forms_of(name) for name, _ in request.effects]
        self.kinds = [forms[int(rng.integers(len(forms)))] for forms in kinds]
        self.first = self._clip(request.clips[0])
        twin, camera = self.first.coarse_twin, self.first.start.camera
        # Of the clip on the fit's grid, so that a spare clip needs no other.
        self.scale = framed_camera(camera, twin, setup.image_side).fx / camera.fx

    def made(self) -> list[MadeScene]:
        """All clips.

        Raises:
            SimulationError: one of them cannot be simulated, or no strength is large enough.
        """
        first = self.first
        shapes = [
            first.of_size(shape, size)
            for shape, (_, size) in zip(self.shapes(), self.request.effects, strict=True)
        ]
        twin = first.twin()
        effects, motion = first.sized(tuple(shapes), twin)
        clips = [self._filmed(first, self.request.clips[0], effects, motion, twin)]
        return clips + [self.later_clip(plan, effects) for plan in self.request.clips[1:]]

    def shapes(self) -> tuple[OutOfFamilyEffect, ...]:
        """The effects of the first clip, with a strength of 1."""
        plan = self.request.clips[0]
        return tuple(
            kind(self._rng(*self._shape_stream(k, plan)), self.first.reference)
            for k, kind in enumerate(self.kinds)
        )

    def later_clip(self, plan: ClipPlan, effects: tuple[OutOfFamilyEffect, ...]) -> MadeScene:
        """Another clip, for effects that have their strengths."""
        clip = self._clip(plan)
        there = tuple(
            kind(self._rng(*self._shape_stream(k, plan)), clip.reference).scaled(effect.strength)
            if scope_of(kind.NAME) is Scope.CLIP
            else effect.moved(clip.reference)
            for k, (kind, effect) in enumerate(zip(self.kinds, effects, strict=True))
        )
        twin = clip.twin()
        return self._filmed(clip, plan, there, clip.moved(there, twin), twin)

    def _filmed(
        self,
        clip: ClipMaker,
        plan: ClipPlan,
        effects: tuple[OutOfFamilyEffect, ...],
        motion: Tensor,
        twin: Tensor,
    ) -> MadeScene:
        own = clip.start.camera.fx / self.first.start.camera.fx
        made = clip.filmed(effects, motion, twin, self.scale / own)
        session = {
            "motion": plan.motion,
            "attempt": self.attempt,
            "strengths": {e.NAME: e.strength for e in effects},
            "forms": {e.NAME: type(e).__name__ for e in effects},
        }
        return replace(made, label={**made.label, "session": session})

    def _clip(self, plan: ClipPlan) -> ClipMaker:
        setup = replace(
            self.setup,
            n_frames=plan.n_frames,
            fps=plan.fps,
            substeps=max(self.setup.substeps + self.more_substeps, 2),
        )
        request = SceneRequest(self.request.name, self.request.effects, self.request.seed)
        return ClipMaker(setup, self._base(setup, plan), request, self.attempt)

    def _base(self, setup: OutOfFamilySettings, plan: ClipPlan) -> BaseScene:
        """The session's cloth with what is drawn for a clip."""
        # The same stream for every clip: the same cloth. Network units depend on the frame rate, so that a
        # clip with another one must be drawn, not changed.
        base = draw_base(setup, self._rng(_BASE))
        rng = self._rng(_CLIP, *plan.stream)
        initial, wind = draw_winds(rng, base.settings.gravity, *_WINDS[plan.motion])
        motion = draw_motion(rng, _CORNERS[plan.motion])
        settings = replace(
            base.settings,
            initial_wind=initial,
            wind=wind,
            pinned_motion=motion,
            seed=int(rng.integers(2**31)),
        )
        if self.compression is not None:
            # One diagonal is as stiff against a shear angle as a quarter of the angles of a cell, and only
            # as much of the other one as resists compression.
            settings = replace(settings, shearing=settings.shearing * 4 / (1 + self.compression[1]))
        return replace(base, settings=settings, compression=self.compression, turned=plan.motion == "turned")

    def _shape_stream(self, effect: int, plan: ClipPlan) -> tuple[int, ...]:
        kind = self.kinds[effect]
        if scope_of(kind.NAME) is Scope.CLIP:
            return _CLIP_SHAPE, effect, *plan.stream
        return _SHAPE, effect

    def _rng(self, *stream: int) -> np.random.Generator:
        return np.random.default_rng([self.request.seed, self.attempt, *stream])


def _check(request: SessionRequest) -> None:
    """Raise InputError for an effect or a size that is none."""
    for name, size in request.effects:
        size_of(forms_of(name)[0], size)
