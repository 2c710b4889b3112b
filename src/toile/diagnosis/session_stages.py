"""The stages of a diagnosis of several clips: what each does, and what it depends on."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar, TypeVarTuple

import numpy as np
from numpy.typing import NDArray

from toile.diagnosis.base_fit import N_WIND
from toile.diagnosis.fingerprint import fingerprint
from toile.diagnosis.joint_fit import (
    JointClip,
    JointFit,
    JointFitSettings,
    JointFitting,
    fitted_velocities,
    frame_positions,
    joint_clip,
)
from toile.diagnosis.mechanics import shooting_of, start_material, surroundings
from toile.diagnosis.model_errors import ModelErrors, model_errors, with_share
from toile.diagnosis.model_grid import ModelGrid, model_grid
from toile.diagnosis.pipeline import Pipeline, PipelineStage, Progress
from toile.diagnosis.planned_clip import HELD_STILL, STILL_AIR
from toile.diagnosis.problem import DiagnosisProblem
from toile.diagnosis.results import Seen, TrackedMotion
from toile.diagnosis.session_settings import SessionSettings
from toile.diagnosis.softened import softened
from toile.diagnosis.stages import DiagnosisStages
from toile.diagnosis.touched_obstacles import TouchedObstacles, touching
from toile.diagnosis.uneven_errors import uneven_errors
from toile.effects.base import Effect
from toile.effects.catalogue import CATALOGUE
from toile.effects.contact import Contact
from toile.scenes.scene import Scene
from toile.workers import ALONE, Workers

Array = NDArray[np.float64]
Own = Sequence[Mapping[str, Effect]]
Inputs = TypeVarTuple("Inputs")
Output = TypeVar("Output")


_ROUGH = 0.02
"""Share of the misfit that a pass gains, below which a fit ends that another one follows."""


@dataclass(frozen=True)
class SeenClip:
    """A clip after tracking.

    Attributes:
        problem: the clip.
        device: that filmed it, from 0.
        tracked: its motion.
        seen: what its images say beside.
        still_air: whether no steady wind blew.
        held_still: whether nobody moved the pinned vertices.
        let_go: whether they do not stay all the same, see holder_slips.let_go.
    """

    problem: DiagnosisProblem
    device: int
    tracked: TrackedMotion
    seen: Seen
    still_air: bool = False
    held_still: bool = False
    let_go: bool = False

    @property
    def stays(self) -> bool:
        """Whether the pinned vertices are held where they are."""
        return self.held_still and not self.let_go

    @property
    def n_frames(self) -> int:
        """Frames in which tracking keeps the cloth."""
        return min(self.problem.scene.n_frames, self.seen.known)


def seen_clips(
    problems: Sequence[DiagnosisProblem],
    devices: Sequence[int],
    pipeline: Pipeline,
    progress: Progress,
    motions: Sequence[str] | None = None,
) -> list[SeenClip]:
    """Track every clip, and look at its images.

    Args:
        problems: the clips; all of their frames are fitted.
        devices: that filmed them.
        pipeline: runs the stages, or reads what they have found.
        progress: called with what is being done and the share that is done.
        motions: what was done in the clips, see planned_clip.PERFORMANCES; None where nobody knows.
    """
    found = []
    for k, (problem, device) in enumerate(zip(problems, devices, strict=True)):

        def of_clip(what: str, share: float, k: int = k) -> None:
            progress(f"clip {k + 1}: {what}", 0.5 * (k + min(share / 0.45, 1.0)) / len(problems))

        stages = DiagnosisStages(problem, of_clip)
        tracked = pipeline.run(_named(stages.tracking(), k))
        seen = pipeline.run(_named(stages.image_cues(), k), tracked)
        done = "" if motions is None else motions[k]
        found.append(SeenClip(problem, device, tracked, seen, done in STILL_AIR, done in HELD_STILL))
    return found


def _named(stage: PipelineStage[*Inputs, Output], clip: int) -> PipelineStage[*Inputs, Output]:
    return replace(stage, name=f"{stage.name} of clip {clip}", file=f"clip_{clip}/{stage.file}")


@dataclass(frozen=True, eq=False)
class RefinedMotion:
    """Motion of all clips as the base model with small forces sees it.

    Attributes:
        positions: of every clip, on the scene's grid (F, N, 3) [m].
        values: log ratios of the base model's numbers to their start values, and the winds of all clips
            (P + 2 C,), where fits begin; None where none was fitted.
        error: of the base model on it, root mean square over the cloth's width; None: as the settings say.
        velocities: of every clip on the model's grid (F, N, 3) [m/s], where fits begin; None: as tracked.
        unknowns: of every window of every clip (n_local,), in units of their deviations from positions and
            velocities, where fits without forces of their own begin; None: none. A last window may be shorter
            and have fewer.
        uneven: of every clip, the variance of the base model's errors at every vertex of its grid over
            the mean (N,), see uneven_errors; None: alike everywhere.
    """

    positions: list[Array]
    values: Array | None
    error: float | None = None
    velocities: list[Array] | None = None
    unknowns: list[list[Array]] | None = None
    uneven: list[Array] | None = None


class SessionModel:
    """The joint problem of all clips; made anew from what tracking has found.

    Attributes:
        own: see JointClip, of every clip.

    Args:
        clips: see SeenClip.
        motion: where the image term is linearised and windows start.
        settings: see SessionSettings.
        stiffness: start values Y [N/m], S per cell area [N/m], B [N·m].
        own: see JointClip, of every clip; None for nothing.
    """

    def __init__(
        self,
        clips: Sequence[SeenClip],
        motion: RefinedMotion,
        settings: SessionSettings,
        stiffness: tuple[float, float, float],
        own: Own | None = None,
    ) -> None:
        settings = replace(settings, model_error=with_share(settings.model_error, motion.error))
        self.clips, self.settings, self._stiffness = list(clips), settings, stiffness
        self._uneven: Sequence[Array | None] = motion.uneven or [None] * len(clips)
        self.grids = [_grid(clip, settings) for clip in clips]
        start = start_material(self.grids[0], stiffness)
        at = len(start)
        values = np.zeros(at + N_WIND * len(clips)) if motion.values is None else motion.values
        winds, values = values[at:].reshape(-1, N_WIND), values[:at]
        of_clips = [
            _joint(clip, grid, motion, k, tuple(winds[k]), settings)
            for k, (clip, grid) in enumerate(zip(clips, self.grids, strict=True))
        ]
        self.own: Own = [{}] * len(of_clips) if own is None else own
        of_clips = [replace(clip, own=there) for clip, there in zip(of_clips, self.own, strict=True)]
        usual = tuple(CATALOGUE[name]() for name in settings.usual)
        self.fitting = JointFitting(of_clips, start, values, settings.fit, usual)
        fewer = replace(settings.fit, passes=settings.left_out_passes)
        self.left_out = (
            JointFitting(of_clips[:-1], start, values, fewer, usual) if len(of_clips) > 1 else None
        )

    @property
    def width(self) -> float:
        """Of the cloth [m]."""
        return self.grids[0].cloth_size[0]

    def errors(self, fit: JointFit) -> ModelErrors:
        """Smooth errors of a fit in all clips."""
        return ModelErrors.of_all(
            model_errors(clip.shooting, windows, self.width, self.settings.model_error, uneven)
            for clip, windows, uneven in zip(self.fitting.clips, fit.windows, self._uneven, strict=True)
        )

    def uneven_errors(self, fit: JointFit) -> list[Array]:
        """How uneven the errors of a fit are in every clip, see RefinedMotion."""
        return [
            uneven_errors(
                clip.shooting,
                windows,
                self.settings.model_error.lasting(seen.problem.scene.fps),
                uneven,
            )
            for seen, clip, windows, uneven in zip(
                self.clips, self.fitting.clips, fit.windows, self._uneven, strict=True
            )
        ]

    def looks_for_obstacles(self, effects: Sequence[Effect]) -> bool:
        """Whether it is asked for what the cloth may touch, and nobody knows it.

        Args:
            effects: candidates; contact among them comes with its obstacle.
        """
        return self.settings.touched is not None and all(e.NAME != Contact.NAME for e in effects)

    def obstacles(self, base: JointFit, workers: Workers = ALONE) -> TouchedObstacles:
        """What the cloth may touch in every clip.

        Args:
            base: the base model, fitted.
            workers: share the windows of a clip.
        """
        assert self.settings.touched is not None
        return touching(self.fitting, base, self.settings.touched, workers)

    def with_obstacles(self, obstacles: TouchedObstacles) -> SessionModel:
        """The same with what the cloth may touch in every clip."""
        other = copy.copy(self)
        other.own = obstacles.of_clips
        other.fitting = self.fitting.with_own(other.own)
        other.left_out = None if self.left_out is None else self.left_out.with_own(other.own[:-1])
        return other

    def last_clip_of(self, effects: Sequence[Effect], fit: JointFit, workers: Workers = ALONE) -> JointClip:
        """The last clip around the motion that a hypothesis refines it to, in one round of that clip alone.

        Args:
            effects: of the hypothesis; () for the base model without any.
            fit: of it, to all clips.
            workers: share the windows of the clip.
        """
        last = len(self.clips) - 1
        layout = self.fitting.layout(effects)
        seen, motion = self.clips[last:], self.refined(fit)
        assert motion.velocities is not None
        motion = RefinedMotion(
            motion.positions[last:],
            fit.values[layout.base(last)],
            self.settings.model_error.share,
            motion.velocities[last:],
        )
        own = self.own[last:]
        alone = SessionModel(seen, motion, refining(self.settings), self._stiffness, own)
        there = np.concatenate([np.zeros(0, np.intp), *layout.coefficients(last)])
        begin = alone.fitting.started(effects, fit.coefficients[there], workers)
        found = alone.refined(alone.fitting.fitted(effects, begin, workers, spread=False))
        uneven = self._uneven[last]
        found = replace(found, error=motion.error, uneven=None if uneven is None else [uneven])
        return SessionModel(seen, found, self.settings, self._stiffness, own).fitting.clips[0]

    def refined(self, fit: JointFit, details: RefinedMotion | None = None) -> RefinedMotion:
        """The motion of a fit, on the scenes' grids.

        Args:
            fit: of this model.
            details: the motion of which it has what this model's grid cannot have; None: nothing.
        """
        positions = []
        for c, (clip, grid) in enumerate(zip(self.fitting.clips, self.grids, strict=True)):
            frames = frame_positions(clip.shooting, fit.windows[c])
            if details is not None:
                frames = frames - np.einsum("nv,fvc->fnc", grid.restrict, details.positions[c])
            found = np.einsum("vn,fnc->fvc", grid.prolong, frames)
            positions.append(found if details is None else details.positions[c] + found)
        pairs = zip(self.fitting.clips, fit.windows, strict=True)
        velocities = [fitted_velocities(clip.shooting, windows) for clip, windows in pairs]
        return RefinedMotion(positions, fit.values, velocities=velocities)


def model_grids(clips: Sequence[SeenClip], settings: SessionSettings) -> list[ModelGrid]:
    """The grid of the model in every clip."""
    return [_grid(clip, settings) for clip in clips]


def on_other_grids(
    motion: RefinedMotion, before: Sequence[ModelGrid], grids: Sequence[ModelGrid]
) -> RefinedMotion:
    """The same motion with velocities for a model on other grids.

    Args:
        motion: with velocities on the grids ``before``, if it has any.
        before: grids of every clip.
        grids: the other ones.
    """
    same = all(here.grid == there.grid for here, there in zip(before, grids, strict=True))
    if motion.velocities is None or same:
        return motion
    velocities = [
        np.einsum("mv,vn,fnc->fmc", there.restrict, here.prolong, v, optimize=True)
        for here, there, v in zip(before, grids, motion.velocities, strict=True)
    ]
    # Unknowns of windows are of positions and velocities that are others now.
    return replace(motion, velocities=velocities, unknowns=None)


def refined_motion(
    clips: Sequence[SeenClip],
    settings: SessionSettings,
    stiffness: tuple[float, float, float],
    workers: Workers = ALONE,
    begin: RefinedMotion | None = None,
) -> RefinedMotion:
    """Refine what tracking has found.

    How wrong the base model is on these clips is found on the way: with errors thought too large, images
    hardly hold the motion, and every round takes a small part of what is left to them.

    Args:
        clips: tracked.
        settings: see SessionSettings.
        stiffness: where fits begin.
        workers: share the windows of a clip.
        begin: another motion, to be refined in place of the tracked one.
    """
    if begin is None:
        motion = RefinedMotion([clip.tracked.positions[: clip.n_frames] for clip in clips], None)
    else:
        motion = RefinedMotion(begin.positions, begin.values, begin.error)
    s = settings.refining
    told, clips = clips, _in_any_wind(clips)
    coarse = replace(settings, side=min(s.side, settings.side))
    firm = _with_its_modes(replace(coarse, fit=_rough(replace(settings.fit, passes=max(s.firm, 1)))))
    stages = ((refining(coarse), s.rounds), (firm, min(s.firm, 1)), (refining(settings), s.finer))
    on = model_grids(clips, coarse)
    for of_rounds, rounds in stages:
        before_on, on = on, model_grids(clips, of_rounds)
        motion = on_other_grids(motion, before_on, on)
        for _ in range(rounds):
            model = SessionModel(clips, motion, of_rounds, stiffness)
            fit = model.fitting.fitted((), model.fitting.start_fit(workers), workers)
            error = model.errors(fit).found
            # The model may be righter than was thought: then images hold the motion more tightly next time.
            of_details = motion if of_rounds.side < settings.side else None
            before, motion = motion, replace(model.refined(fit, of_details), error=error)
            if _change(before, motion) < s.steady * error * model.width:
                break
    motion = on_other_grids(motion, on, model_grids(clips, settings))
    return with_error_found(told, motion, settings, stiffness, workers)


def loosened(
    clips: Sequence[SeenClip],
    motion: RefinedMotion,
    settings: SessionSettings,
    stiffness: tuple[float, float, float],
    workers: Workers = ALONE,
) -> RefinedMotion:
    """A refined motion whose pinned vertices are no longer held: where images and the laws see them.

    Args:
        clips: tracked.
        motion: refined.
        settings: see SessionSettings.
        stiffness: where fits begin.
        workers: share the windows of a clip.
    """
    s, clips = settings.refining, _in_any_wind(clips)
    coarse = replace(settings, side=min(s.side, settings.side), held=max(settings.held, settings.boundary))
    error = motion.error
    motion = on_other_grids(motion, model_grids(clips, settings), model_grids(clips, coarse))
    for _ in range(s.loose):
        model = SessionModel(clips, motion, refining(coarse), stiffness)
        fit = model.fitting.fitted((), model.fitting.start_fit(workers), workers)
        found = model.refined(fit, motion if coarse.side < settings.side else None)
        motion = replace(found, error=error)
    return motion


def _in_any_wind(clips: Sequence[SeenClip]) -> list[SeenClip]:
    """The clips without what is known of their air: the base model finds gusts and a tilt by a wind."""
    return [replace(clip, still_air=False) for clip in clips]


def _with_its_modes(settings: SessionSettings) -> SessionSettings:
    """The settings with as many modes of a window's start as refining has."""
    return replace(settings, modes=max(settings.modes, min(settings.refining.modes, 2 * settings.side // 3)))


def refining(settings: SessionSettings) -> SessionSettings:
    """The settings of one loose round of refining: looser jumps, few passes, its modes."""
    s = settings.refining
    return replace(
        _with_its_modes(settings),
        jump_position=s.jumps * settings.jump_position,
        jump_velocity=s.jumps * settings.jump_velocity,
        fit=replace(settings.fit, passes=s.passes),
    )


def _rough(settings: JointFitSettings) -> JointFitSettings:
    """Of a fit that another one follows."""
    return replace(settings, converged=max(_ROUGH, settings.converged))


def _change(before: RefinedMotion, after: RefinedMotion) -> float:
    """Between two motions, root mean square over all vertices and frames [m]."""
    pairs = zip(before.positions, after.positions, strict=True)
    squares = [((b - a) ** 2).sum(-1).ravel() for a, b in pairs]
    return float(np.sqrt(np.concatenate(squares).mean()))


def with_error_found(
    clips: Sequence[SeenClip],
    motion: RefinedMotion,
    settings: SessionSettings,
    stiffness: tuple[float, float, float],
    workers: Workers = ALONE,
) -> RefinedMotion:
    """The motion with the size of the base model's errors on it, and the material that goes with it.

    Args:
        clips: tracked.
        motion: refined, or true.
        settings: see SessionSettings.
        stiffness: where fits begin.
        workers: share the windows of a clip.
    """
    return _with_errors_found(clips, motion, settings, stiffness, workers, settings.error_rounds)


def with_uneven_errors(
    clips: Sequence[SeenClip],
    motion: RefinedMotion,
    settings: SessionSettings,
    stiffness: tuple[float, float, float],
    workers: Workers = ALONE,
) -> RefinedMotion:
    """The motion with where the base model is wrong on it by how much, and the material that goes with it.

    Args:
        clips: tracked.
        motion: with the size of errors that are alike everywhere.
        settings: see SessionSettings; with no ``uneven_rounds`` they stay alike.
        stiffness: where fits begin.
        workers: share the windows of a clip.
    """
    rounds = settings.uneven_rounds
    return _with_errors_found(clips, motion, settings, stiffness, workers, rounds, uneven=True)


def _with_errors_found(
    clips: Sequence[SeenClip],
    motion: RefinedMotion,
    settings: SessionSettings,
    stiffness: tuple[float, float, float],
    workers: Workers,
    rounds: int,
    *,
    uneven: bool = False,
) -> RefinedMotion:
    base: JointFit | None = None
    rough = replace(settings, fit=_rough(settings.fit))
    for rounds_left in range(rounds - 1, -1, -1):
        # Another size of the errors moves the fit by more than what its last passes gain.
        model = SessionModel(clips, motion, rough if rounds_left else settings, stiffness)
        fitting = model.fitting
        start = fitting.start_fit(workers) if base is None else fitting.costed((), base)
        base = fitting.fitted((), start, workers)
        found = model.errors(base).found
        # The windows refer to the same motion as before, so what they differ by is kept, and not their speed.
        unknowns = [[window.standardised for window in windows] for windows in base.windows]
        if uneven:
            motion = replace(motion, uneven=model.uneven_errors(base))
        motion = replace(motion, error=found, values=base.values, unknowns=unknowns)
    return motion


def uneven_stage(
    clips: Sequence[SeenClip],
    settings: SessionSettings,
    stiffness: tuple[float, float, float],
    share: float,
    made_from: Mapping[str, str],
    workers: Workers = ALONE,
) -> PipelineStage[RefinedMotion, RefinedMotion]:
    """See with_uneven_errors; made from the refined motion.

    Args:
        clips: tracked.
        settings: see SessionSettings.
        stiffness: where fits begin.
        share: of all work that is done when it begins.
        made_from: fingerprints of what it depends on.
        workers: share the windows of a clip.
    """

    def compute(motion: RefinedMotion) -> RefinedMotion:
        return with_uneven_errors(clips, motion, settings, stiffness, workers)

    return PipelineStage(
        "uneven errors",
        "uneven.npz",
        "where the base model is wrong",
        share,
        RefinedMotion,
        compute,
        dict(made_from),
    )


def _grid(clip: SeenClip, settings: SessionSettings) -> ModelGrid:
    problem = clip.problem
    side = min(settings.side, *problem.scene.grid)
    return model_grid(problem.scene, problem.reconstruction.cloth, side, settings.law, settings.crowding)


def _held(scene: Scene, positions: Array) -> Array:
    """A motion (F, N, 3) [m] whose pinned vertices stay.

    Along the line of sight, of which images say little, where the template has them; across it a template may
    be off by more than they move, so there they are where they were found, median frame.
    """
    pinned = list(scene.pinned_vertices)
    at = scene.template.reshape(-1, 3)[pinned].numpy().astype(np.float64)
    ray = at / np.linalg.norm(at, axis=-1, keepdims=True)
    away = positions[:, pinned] - at
    across = away - (away * ray).sum(-1, keepdims=True) * ray
    positions = positions.copy()
    positions[:, pinned] = at + np.median(across, axis=0)
    return positions


def _joint(
    clip: SeenClip,
    grid: ModelGrid,
    motion: RefinedMotion,
    k: int,
    wind: tuple[float, ...],
    s: SessionSettings,
) -> JointClip:
    """Clip k of a session."""
    positions = motion.positions[k]
    problem = clip.problem
    fps, of_clip = problem.scene.fps, problem.settings.shooting
    # Only where they are thought to stay: otherwise they are where the motion has them.
    if clip.stays and s.held < s.boundary:
        positions = _held(problem.scene, positions)
    tracked = problem.images_around(positions, grid)
    uneven = None if motion.uneven is None else motion.uneven[k]
    tracked = softened(tracked, grid.cloth_size[0], fps, s.likelihood_weight, s.model_error, uneven)
    window, jumps = s.windows_at(fps)
    own = replace(
        of_clip,
        window=window,
        jump_position=jumps * s.jump_position,
        jump_velocity=jumps * s.jump_velocity,
        boundary_knot=max(1, round(s.boundary_knot * fps)),
        force_knot=max(1, round(s.window * fps / 2)),
        boundary=s.held if clip.stays else s.boundary,
        modes=s.modes,
        likelihood_weight=1.0,
    )
    shooting = shooting_of(problem.scene, grid, tracked, own, s.longest_substep, s.newton_iterations)
    around = replace(surroundings(problem.scene, grid), still_air=clip.still_air)
    free = s.fit.force > 0
    joint = joint_clip(
        shooting,
        around,
        len(positions),
        clip.device,
        forces=free,
        velocities=None if motion.velocities is None else motion.velocities[k],
        wind=wind,
    )
    if motion.unknowns is None or free:
        return joint
    pairs = zip(joint.windows, motion.unknowns[k], strict=True)
    return replace(joint, windows=[replace(window, standardised=own) for window, own in pairs])


@dataclass(frozen=True)
class HypothesisStages:
    """Fits of hypotheses as stages.

    Attributes:
        model: see SessionModel.
        progress: called with what is being done and the share that is done.
        made_from: fingerprints of what every fit depends on.
        workers: share the windows of a clip.
    """

    model: SessionModel
    progress: Progress
    made_from: dict[str, str]
    workers: Workers = ALONE

    def plain(self, share: float) -> PipelineStage[RefinedMotion, JointFit]:
        """The fit of the base model without its usual effects to all clips.

        Args:
            share: of all work that is done when it begins.
        """
        fitting = self.model.fitting

        def compute(motion: RefinedMotion) -> JointFit:
            return fitting.fitted((), fitting.start_fit(self.workers), self.workers)

        return PipelineStage(
            "plain fit", "fits/plain.npz", "fit without any effect", share, JointFit, compute, self.made_from
        )

    def usual(self, share: float) -> PipelineStage[RefinedMotion, JointFit, JointFit]:
        """The fit with the usual effects, from the plain one; the plain one where there are none.

        Args:
            share: of all work that is done when it begins.
        """
        fitting = self.model.fitting

        def compute(motion: RefinedMotion, plain: JointFit) -> JointFit:
            return fitting.fitted(fitting.usual, plain, self.workers) if fitting.usual else plain

        return PipelineStage(
            "usual effects",
            "fits/usual.npz",
            "fit of usual effects",
            share,
            JointFit,
            compute,
            self.made_from,
        )

    def obstacles(self, share: float) -> PipelineStage[RefinedMotion, JointFit, TouchedObstacles]:
        """What the cloth may touch in every clip.

        Args:
            share: of all work that is done when it begins.
        """

        def compute(motion: RefinedMotion, base: JointFit) -> TouchedObstacles:
            return self.model.obstacles(base, self.workers)

        return PipelineStage(
            "what the cloth may touch",
            "fits/obstacles.npz",
            "what the cloth may touch",
            share,
            TouchedObstacles,
            compute,
            self.made_from,
        )

    def fit(self, effect: Effect, share: float) -> PipelineStage[RefinedMotion, JointFit, JointFit]:
        """The fit of a hypothesis to all clips, from where the base model has ended: it cannot be worse.

        Args:
            effect: in question.
            share: of all work that is done when it begins.
        """
        name, fitting = effect.NAME, self.model.fitting

        def compute(motion: RefinedMotion, base: JointFit) -> JointFit:
            return fitting.fitted_hypothesis(effect, base, self.workers)

        made_from = {**self.made_from, "effect": fingerprint((effect,))}
        return PipelineStage(
            f"fit of {name}", f"fits/{name}.npz", f"fit of {name}", share, JointFit, compute, made_from
        )

    def fit_beside(
        self, fitting: JointFitting, effect: Effect, first: str, share: float
    ) -> PipelineStage[RefinedMotion, JointFit, JointFit]:
        """The fit of a second effect, from where the fit of the first one has ended.

        Args:
            fitting: whose base model has the first one.
            effect: in question.
            first: name of the effect that acts.
            share: of all work that is done when it begins.
        """
        name = effect.NAME

        def compute(motion: RefinedMotion, with_first: JointFit) -> JointFit:
            return fitting.fitted_hypothesis(effect, with_first, self.workers)

        return PipelineStage(
            f"fit of {name} beside {first}",
            f"fits/{name}_beside_{first}.npz",
            f"fit of {name} beside {first}",
            share,
            JointFit,
            compute,
            {**self.made_from, "effect": fingerprint((effect,))},
        )
