"""The diagnosis of one clip, from its images to a verdict, stage by stage."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field

from toile.atomic_file import written_atomically
from toile.diagnosis.aliases import alias_of
from toile.diagnosis.answer import Weighed, best_scoring, weighed
from toile.diagnosis.attachment_slip import SlipFit, SlipSettings, slip_evidence
from toile.diagnosis.brightness_cue import (
    BrightnessFit,
    BrightnessSettings,
    brightness_evidence,
    measured_brightness,
)
from toile.diagnosis.continuity import Discrepancy
from toile.diagnosis.decision import Calibration, Weights
from toile.diagnosis.effect_size import effect_size
from toile.diagnosis.evidence import EvidenceSettings
from toile.diagnosis.findings import (
    WIDENED,
    Finding,
    estimates,
    finding,
    mechanical_findings,
    naive_answer,
)
from toile.diagnosis.fingerprint import code_fingerprint, fingerprint
from toile.diagnosis.gap_maps import GapMaps, gap_maps, stage_shares
from toile.diagnosis.made_with import MADE_WITH_FILE, MadeWith
from toile.diagnosis.mechanics import (
    Mechanics,
    analyse_mechanics,
    mechanics_around,
    shooting_of,
    substeps_per_frame,
    surroundings,
)
from toile.diagnosis.model_grid import ModelGrid, model_grids
from toile.diagnosis.numerics import StepRefinement, halved, time_step_error
from toile.diagnosis.outline_cue import OutlineFit, OutlineSettings, outline_evidence, template_outline
from toile.diagnosis.record import CalibrationUse, EffectReport, GapReport, Protocol, Where
from toile.diagnosis.refits import Race, RefitSettings, converged, refits
from toile.diagnosis.sharpness import ExposureFit, ExposureSettings, exposure_evidence, smear
from toile.diagnosis.shooting import Shooting, ShootingSettings
from toile.diagnosis.shrinkage import HeldOut, PredictionSettings, held_out_shrinks, prediction_gains
from toile.diagnosis.stage_store import Result, StageStore
from toile.diagnosis.stage_times import TIMES_FILE, StageTimes
from toile.diagnosis.stages import (
    BASE_MODEL,
    CONVERGED_BASE,
    FILES,
    HELD_OUT,
    IMAGES,
    KINDS,
    MAPS,
    NUMERICS,
    REFITS,
    TRACKING,
    WINDOW_PREDICTIONS,
    BaseModel,
    ConvergedBase,
    Seen,
    StepError,
    TrackedMotion,
    WindowPredictions,
    settings_of,
)
from toile.diagnosis.stored_values import ValueStore
from toile.diagnosis.tracked import CoarseTracking, Tracked, point_settings, track, tracked_motion
from toile.diagnosis.verdict import VerdictSettings, until, verdict_of
from toile.diagnosis.workers import ALONE, Workers
from toile.effects.anchor_slip import AnchorSlip
from toile.effects.base import BrightnessEffect, CameraEffect, Effect, ExposureEffect, MaskEffect
from toile.effects.catalogue import STAGES
from toile.errors import InputError
from toile.limits import Count, CountOrZero, Fraction, Positive, Seed, Unit
from toile.physics.implicit.integrators import BDF2
from toile.physics.implicit.simulator import ImplicitSimulator
from toile.reconstruction.gauss_newton.recipe import TrackingRecipe
from toile.reconstruction.lost_cloth import LEAST, first_lost, outline_overlap
from toile.reconstruction.problem import Reconstruction
from toile.scenes.scene import Scene

T = TypeVar("T")
Array = NDArray[np.float64]
Progress = Callable[[str, float], None]
"""Called with what is being done and the share that is done."""

Side = Annotated[int, Field(ge=3)]
"""Vertices along a side of a grid."""

_log = logging.getLogger(__name__)

TRACKED_FILE = FILES[TRACKING]
VERTICES_FILE = "gap_vertices.npy"
FRAMES_FILE = "gap_frames_vertices.npy"
SCREENING_FILE = "screening.npz"
HELD_OUT_FILE = "held_out.npz"
"""Predicted positions of the held-out frames on the scene's grid, by what was in the model."""

# What of a scene a diagnosis looks at: everything but what it is called, where it lies, and the truth.
_SEEN = [f.name for f in fields(Scene) if f.name not in ("name", "source", "notes", "ground_truth")]


@dataclass(frozen=True)
class DiagnosisSettings:
    """How a clip is diagnosed.

    Attributes:
        sides: vertices along each side of the model's grids, coarse to fine; the scene's own at most.
        held_out: share of the frames at the end that nothing is fitted to.
        coarse: the first pass of tracking; None for none.
        shooting: windows and priors.
        stiffness: start values Y [N/m], S per cell area [N/m] and B [N·m]: the same fabric on every grid.
        longest_substep: of the base model [s].
        refinement: of those steps until shorter ones change nothing; None to measure their error only.
        usual_discrepancy: that a right model still needs; beyond it something is missing.
        usual_cost: of the images that a right model leaves, per fitted frame; if the best one leaves more,
            what speaks for an effect counts for less, and ``none`` is no proof that nothing is missing.
        refitted: how many effects that move the cloth are fitted on their own, the best-scoring first: in a
            first pass, in a second one, and so on.
        base_refits: of the base model at most, with forces of the size that it needs.
        weights: what evidence from fitted windows and that prediction count for.
        compared: effects whose prediction of held-out frames is measured.
        placebos: force fields without meaning that are fitted and predicted beside them.
        seed: of everything random.
        fewest_frames: that are fitted at least; a clip with fewer is refused, and as many are used whatever
            is lost.
        least_overlap: of the outline with the mask, as a share of frame 0's; with less the cloth is lost.
        outline: camera and mask, see OutlineSettings.
        brightness: light, see BrightnessSettings.
        exposure: see ExposureSettings.
        attachment_slip: see GripSettings.
        evidence: of effects that move the cloth, see EvidenceSettings.
        refits: see RefitSettings.
        prediction: see PredictionSettings.
        widened: factor by which intervals of the linearised model are too narrow.
        verdict: when an answer is given, see VerdictSettings.
        calibration: file that makes probabilities of evidence, of ``toile calibrate``; None for the package's
            own.
    """

    sides: Annotated[tuple[Side, ...], Field(min_length=1), Unit("vertices")] = (20,)
    held_out: Annotated[float, Field(ge=0, lt=1)] = 0.25
    coarse: CoarseTracking | None = field(default_factory=CoarseTracking)
    shooting: ShootingSettings = field(default_factory=ShootingSettings)
    stiffness: tuple[Positive, Positive, Positive] = (850.0, 2.8, 5.3e-5)
    longest_substep: Annotated[Positive, Unit("s")] = 0.005
    refinement: StepRefinement | None = None
    usual_discrepancy: Discrepancy = field(default_factory=lambda: Discrepancy(1.6, 0.1))
    usual_cost: Positive = 15.0
    refitted: tuple[CountOrZero, ...] = (5, 2)
    base_refits: CountOrZero = 4
    weights: Weights = field(default_factory=Weights)
    compared: CountOrZero = 3
    placebos: CountOrZero = 3
    seed: Seed = 0
    fewest_frames: Annotated[Count, Unit("frames")] = 6
    least_overlap: Fraction = LEAST
    outline: OutlineSettings = field(default_factory=OutlineSettings)
    brightness: BrightnessSettings = field(default_factory=BrightnessSettings)
    exposure: ExposureSettings = field(default_factory=ExposureSettings)
    attachment_slip: SlipSettings = field(default_factory=SlipSettings)
    evidence: EvidenceSettings = field(default_factory=EvidenceSettings)
    refits: RefitSettings = field(default_factory=RefitSettings)
    prediction: PredictionSettings = field(default_factory=PredictionSettings)
    widened: Positive = WIDENED
    verdict: VerdictSettings = field(default_factory=VerdictSettings)
    calibration: str | None = None


def diagnose(
    reconstruction: Reconstruction,
    recipe: TrackingRecipe,
    effects: Sequence[Effect],
    settings: DiagnosisSettings,
    folder: Path,
    progress: Progress,
    workers: Workers = ALONE,
    made_with: MadeWith | None = None,
) -> GapReport:
    """Diagnose a clip; results of its stages go into the folder, and those that are there are used again.

    Args:
        reconstruction: the scene with its cloth and free forces; its parameters are changed in place.
        recipe: tracks the motion; its last stage is used.
        effects: candidates, at zero.
        settings: see DiagnosisSettings.
        folder: of the run.
        progress: called with what is being done and the share that is done.
        workers: share what can be done side by side.
        made_with: all settings that matter, those of tracking among them; None if nobody knows: then
            probabilities are uncalibrated.

    Returns:
        The report; the caller writes it.

    Raises:
        InputError: the clip is too short or its frames are unevenly spaced, or something is asked for that a
            diagnosis does not do.
    """
    check_problem(reconstruction, effects, settings)
    calibration, use = _calibration(settings, made_with, folder)
    clip = _Stages(reconstruction, recipe, effects, settings, calibration, use, folder, progress, workers)
    stages: tuple[tuple[float, str, Callable[[], object]], ...] = (
        (0.0, "tracking", lambda: clip.tracking),
        (0.45, "what the images say", lambda: clip.images),
        (0.5, "base model", lambda: clip.base_model),
        (0.85, "base model, refitted to convergence", lambda: clip.converged_base),
        (0.86, "refits", lambda: clip.refits),
        (0.92, "what the effects predict", lambda: clip.window_predictions),
        (0.94, "time steps of half the length", lambda: clip.numerics),
        (0.95, "held-out frames", lambda: clip.held_out),
        (0.97, "maps", lambda: clip.maps),
        (0.99, "answer", lambda: clip.report),
    )
    for share, what, made in stages:
        progress(what, share)
        made()
    _write_results(clip, folder)
    return clip.report


def fitted_frames(n_frames: int, held_out: float, fewest: int) -> int:
    """Frames that are fitted; those after them are held out.

    Args:
        n_frames: of the clip.
        held_out: share of them.
        fewest: that are fitted at least.

    Raises:
        InputError: the clip is too short for both.
    """

    def fitted(n: int) -> int:
        return n - round(held_out * n)

    if fitted(n_frames) < fewest:
        enough = n_frames + 1
        while fitted(enough) < fewest:
            enough += 1
        raise InputError(
            "The clip is too short for a diagnosis",
            where="scene",
            expected=f"{enough} frames or more: {fewest} to fit, and a share of {held_out:g} held out "
            "(diagnosis.held_out)",
            got=f"{n_frames} frames",
        )
    return fitted(n_frames)


def check_problem(
    reconstruction: Reconstruction, effects: Sequence[Effect], settings: DiagnosisSettings
) -> None:
    """Refuse what a diagnosis cannot do, or would otherwise pass over in silence.

    Raises:
        InputError: unevenly spaced frames, too few of them, another simulator than the base model has,
            effects that act while the motion is tracked, no candidates, or candidates with numbers.
    """
    _require_even_spacing(reconstruction.scene)
    fitted_frames(reconstruction.scene.n_frames, settings.held_out, settings.fewest_frames)
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
            numbers = zip(effect.parameters, effect.values.tolist(), strict=True)
            raise InputError(
                "Candidates start from zero: the question is whether they act at all",
                where=f"candidates.{effect.NAME}.values",
                expected="0 for every one; the diagnosis estimates them",
                got=", ".join(f"{p.name}: {value:g}" for p, value in numbers if value),
            )


def _require_even_spacing(scene: Scene) -> None:
    # Windows, ramps, effect columns and the held-out end all count frames as time.
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


class _Stages:
    """The stages of one clip's diagnosis, each computed, or read where it was made from the same.

    Args: see diagnose; and the calibration, with what the report says of it.
    """

    def __init__(
        self,
        reconstruction: Reconstruction,
        recipe: TrackingRecipe,
        effects: Sequence[Effect],
        settings: DiagnosisSettings,
        calibration: Calibration,
        use: CalibrationUse,
        folder: Path,
        progress: Progress,
        workers: Workers,
    ) -> None:
        self.reconstruction, self.scene = reconstruction, reconstruction.scene
        self.effects, self.settings = tuple(effects), settings
        self._calibration, self._use = calibration, use
        self._recipe, self._progress, self._workers = recipe, progress, workers
        self._fitted = fitted_frames(self.scene.n_frames, settings.held_out, settings.fewest_frames)
        _start_stiffness(reconstruction, settings.stiffness)
        times = StageTimes.going_on(folder / TIMES_FILE)
        self._store = StageStore(folder, ValueStore(KINDS, self.effects), times)
        self._shooting: dict[int, Shooting] = {}
        simulator = reconstruction.simulator
        assert isinstance(simulator, ImplicitSimulator)
        self._problem = {
            "code": code_fingerprint(),
            "scene": fingerprint({name: getattr(self.scene, name) for name in _SEEN}),
            "cloth": fingerprint(reconstruction.cloth),
            "simulator": fingerprint(simulator.newton, simulator.integrator, reconstruction.frame_steps),
            "renderer": fingerprint(
                type(reconstruction.renderer), getattr(reconstruction.renderer, "supersampling", None)
            ),
            "optimization": fingerprint(recipe.stages[-1]),
            "start": fingerprint(reconstruction.parameters.state_dict()),
        }
        self._candidates = {"candidates": fingerprint(self.effects)}

    @property
    def used(self) -> int:
        """Frames that are fitted: as many as are meant to be, as long as tracking keeps the cloth."""
        return min(self._fitted, self.images.value.known)

    @cached_property
    def tracking(self) -> Result[TrackedMotion]:
        """Positions of all frames, with free forces."""
        parameters, settings = self.reconstruction.parameters, self.settings
        start = {name: value.clone() for name, value in parameters.state_dict().items()}
        n_frames = self.scene.n_frames

        def report(frame: int, share: float) -> None:
            self._progress(f"tracking, frame {frame} of {n_frames}", 0.45 * share)

        def compute() -> TrackedMotion:
            torch.manual_seed(settings.seed)
            found = track(
                self.reconstruction,
                self._recipe,
                settings.coarse,
                self._fitted,
                report,
                settings.least_overlap,
            )
            # Nothing that comes after may hang on whether tracking has just been done.
            parameters.load_state_dict(start)
            return TrackedMotion(found)

        return self._result(TRACKING, TrackedMotion, compute)

    @cached_property
    def images(self) -> Result[Seen]:
        """How far tracking keeps the cloth, and traces that are no motion."""

        def compute() -> Seen:
            positions = self.tracking.value.positions
            # What comes after that is no motion of this cloth.
            kept = first_lost(outline_overlap(self.reconstruction, positions), self.settings.least_overlap)
            known = max(self.settings.fewest_frames, kept)
            # Said here, where its time belongs.
            _ = self.levels
            seen = positions[: min(self._fitted, known)]
            return Seen(known, _still_findings(self.reconstruction, seen, self.effects, self.settings))

        return self._result(IMAGES, Seen, compute, (self.tracking,), self._candidates)

    @cached_property
    def levels(self) -> list[tuple[ModelGrid, Tracked]]:
        """Grids of the model, coarse to fine, and the motion on them; made anew, as they are large."""
        points, seed = point_settings(self._recipe), self.settings.seed
        return [
            (grid, tracked_motion(self.reconstruction, self.tracking.value.positions, grid, points, seed))
            for grid in model_grids(self.scene, self.reconstruction.cloth, self.settings.sides)
        ]

    @cached_property
    def base_model(self) -> Result[BaseModel]:
        """Stiffness, wind, starts, boundary positions and forces of all windows."""
        settings, done = self.settings, [0]

        def count(what: str, cost: float) -> None:
            done[0] += 1
            self._progress(f"base model, cost {cost:.0f}", min(0.5 + 0.025 * done[0], 0.85))

        def compute() -> BaseModel:
            found = analyse_mechanics(
                self.scene,
                self.levels,
                self.effects,
                settings.shooting,
                settings.stiffness,
                settings.longest_substep,
                self.used,
                count,
                self._workers,
                settings.refinement,
                settings.evidence,
            )
            finer = found.shooting.substeps // substeps_per_frame(self.scene.fps, settings.longest_substep)
            return BaseModel(found.fit, finer.bit_length() - 1, found.evidence.systems)

        # Whoever the candidates are: the base model hangs on the fitted frames only.
        frames = {"fitted frames": fingerprint(self.used)}
        return self._result(BASE_MODEL, BaseModel, compute, (self.tracking,), frames)

    @cached_property
    def mechanics(self) -> Mechanics:
        """The base model, ready to be worked with."""
        return self._around(self.base_model.value)

    @cached_property
    def converged_base(self) -> Result[ConvergedBase]:
        """The base model with forces of the size that it needs, and effects to first order around it."""
        settings, usual = self.settings, self.settings.usual_discrepancy

        def compute() -> ConvergedBase:
            best = converged(
                self.mechanics,
                self.scene.camera,
                usual,
                settings.base_refits,
                self._workers,
                settings.refits,
            )
            return ConvergedBase(best.fit, best.evidence.systems, mechanical_findings(best, usual))

        after = (self.tracking, self.base_model)
        return self._result(CONVERGED_BASE, ConvergedBase, compute, after, self._candidates)

    @cached_property
    def converged_mechanics(self) -> Mechanics:
        """The converged base model, ready to be worked with."""
        return self._around(self.converged_base.value)

    @cached_property
    def refits(self) -> Result[Race]:
        """Well-scoring effects at their own best fits."""
        screened = self.converged_base.value.screening

        def compute() -> Race:
            return refits(
                self.converged_mechanics,
                best_scoring(screened, self.settings.refits.least_score),
                screened.penalties,
                self.settings.usual_discrepancy,
                self.settings.refitted,
                lambda what, share: self._progress(what, 0.86 + 0.06 * share),
                self._workers,
                self.settings.refits,
            )

        after = (self.tracking, self.base_model, self.converged_base)
        return self._result(REFITS, Race, compute, after, self._candidates)

    @cached_property
    def window_predictions(self) -> Result[WindowPredictions]:
        """What refitted effects predict of every window, and how far they move the cloth."""
        race = self.refits.value

        def compute() -> WindowPredictions:
            gains = prediction_gains(
                self.mechanics, race.base, race.effects, self._workers, self.settings.prediction
            )
            sizes = {
                name: effect_size(self.mechanics, model) / self.width for name, model in race.effects.items()
            }
            return WindowPredictions(gains, sizes)

        after = (self.tracking, self.base_model, self.refits)
        return self._result(WINDOW_PREDICTIONS, WindowPredictions, compute, after, self._candidates)

    @cached_property
    def numerics(self) -> Result[StepError]:
        """What half the time step changes."""

        def compute() -> StepError:
            return StepError(time_step_error(self.mechanics.shooting, self.mechanics.fit))

        after = (self.tracking, self.base_model)
        return self._result(NUMERICS, StepError, compute, after)

    @property
    def width(self) -> float:
        """Of the cloth [m]."""
        return self.mechanics.around.cloth_size[0]

    @cached_property
    def weighed(self) -> Weighed:
        """What speaks for every hypothesis, all taken together."""
        return weighed(
            self.images.value.findings,
            self.converged_base.value.screening,
            self.refits.value,
            self.window_predictions.value,
            self.mechanics.effects,
            step_error=self.numerics.value.distance / self.width,
            used=self.used,
            usual_cost=self.settings.usual_cost,
            weights=self.settings.weights,
            calibration=self._calibration,
        )

    @cached_property
    def held_out(self) -> Result[HeldOut]:
        """Open rollouts over frames that no fit has seen, with the most probable effects."""
        race, settings = self.refits.value, self.settings
        compared = [name for name in self.weighed.ranked if name in race.effects][: settings.compared]

        def compute() -> HeldOut:
            return held_out_shrinks(
                self.mechanics,
                race.base,
                {name: race.effects[name] for name in compared},
                used=self.used,
                known=self.images.value.known,
                horizon=settings.shooting.window,
                n_placebos=settings.placebos,
                seed=settings.seed,
                settings=settings.prediction,
            )

        after = (self.tracking, self.images, self.base_model, self.refits)
        others = {**self._candidates, "compared effects": fingerprint(compared)}
        return self._result(HELD_OUT, HeldOut, compute, after, others)

    @cached_property
    def maps(self) -> Result[GapMaps]:
        """Where the base model departs from the tracked motion."""
        after = (self.tracking, self.base_model)
        return self._result(MAPS, GapMaps, lambda: gap_maps(self.mechanics), after)

    @cached_property
    def report(self) -> GapReport:
        """The answer: it follows from the stages at once, and is stored by nobody but the caller."""
        settings, found, maps = self.settings, self.weighed, self.maps.value
        shrinks, known = self.held_out.value.shrinks, self.images.value.known
        n_frames = self.scene.n_frames
        numerics = min(1.0, self.numerics.value.distance / max(maps.mean, 1e-9))
        explained = found.left <= settings.usual_cost
        verdict = verdict_of(
            found.chances,
            found.evidence,
            self._calibration,
            shrinks,
            explained=explained,
            settings=settings.verdict,
        )
        by_name = {effect.NAME: effect for effect in self.effects}
        best, size = self.converged_mechanics, self.refits.value.discrepancy
        return GapReport(
            until(verdict, known) if known < n_frames else verdict,
            Where(
                stage_shares(found.evidence, self._calibration, numerics),
                maps.frames,
                VERTICES_FILE,
                maps.regimes,
            ),
            tuple(
                EffectReport(
                    name,
                    STAGES[name].value,
                    found.chances[name],
                    estimates(found.findings[name], by_name[name], settings.widened),
                    shrinks.get(name),
                )
                for name in found.ranked
            ),
            alias_of(best, size, self._calibration, settings.weights),
            Protocol(
                settings.seed,
                tuple(range(self.used)),
                tuple(range(self.used, n_frames)),
                f"toile {version('toile')}",
                naive_answer(best, found.findings),
            ),
            self._use,
        )

    def _around(self, found: BaseModel | ConvergedBase) -> Mechanics:
        """A base model that was stored, with the problem that it solves."""
        halvings = self.base_model.value.halvings
        grid, tracked = self.levels[-1]
        if halvings not in self._shooting:
            settings = self.settings
            shooting = shooting_of(self.scene, grid, tracked, settings.shooting, settings.longest_substep)
            for _ in range(halvings):
                shooting = halved(shooting)
            self._shooting[halvings] = shooting
        around = surroundings(self.scene, grid)
        return mechanics_around(
            self._shooting[halvings],
            found.fit,
            found.systems,
            self.effects,
            around,
            self.settings.evidence,
        )

    def _result(
        self,
        stage: str,
        kind: type[T],
        compute: Callable[[], T],
        after: Sequence[Result[Any]] = (),
        others: Mapping[str, str] | None = None,
    ) -> Result[T]:
        """A stage's result, made from the problem, the settings it asks for, other results and more."""
        before = {result.stage: result.digest for result in after}
        inputs = {**self._problem, **settings_of(stage, self.settings), **(others or {}), **before}
        return self._store.result(stage, FILES[stage], kind, inputs, compute)


def _write_results(clip: _Stages, folder: Path) -> None:
    """The arrays that stand beside the report."""
    found, race, maps, held_out = clip.weighed, clip.refits.value, clip.maps.value, clip.held_out.value
    screened, predictions = clip.converged_base.value.screening.findings, clip.window_predictions.value
    findings, fit = found.findings, clip.mechanics.fit
    prolong = clip.levels[-1][0].prolong
    _write_arrays(
        folder / HELD_OUT_FILE,
        {"frames": np.array(held_out.frames, int)}
        | {name: np.einsum("vn,fnc->fvc", prolong, x) for name, x in held_out.positions.items()},
    )
    _write_array(folder / VERTICES_FILE, maps.vertices)
    _write_array(folder / FRAMES_FILE, maps.distances.astype(np.float32))
    _write_arrays(
        folder / SCREENING_FILE,
        {
            "names": np.array(list(found.evidence)),
            "log_evidence": np.array(list(found.evidence.values())),
            "first_order": np.array(
                [screened[n].log_evidence if n in screened else np.nan for n in findings]
            ),
            "in_sample": np.array([f.log_evidence for f in findings.values()]),
            "prediction_gain": np.array([predictions.gains.get(name, np.nan) for name in findings]),
            "size": np.array([predictions.sizes.get(name, np.nan) for name in findings]),  # over the width
            "unknown": np.array(race.beyond),
            "left": np.array(found.left),
            "discrepancy": np.array(race.discrepancy),  # internal, external
            "base": fit.values,
            "time_step_error": np.array(clip.numerics.value.distance),
            "width": np.array(clip.width),
            "costs": np.array(fit.history),
        },
    )


def _calibration(
    settings: DiagnosisSettings, made_with: MadeWith | None, folder: Path
) -> tuple[Calibration, CalibrationUse]:
    """The calibration, and whether it belongs to these settings, which are written down; warns if not."""
    file = None if settings.calibration is None else Path(settings.calibration)
    calibration = Calibration.load(file)
    use = calibration.use(made_with, file)
    if made_with is not None:
        made_with.write(folder / MADE_WITH_FILE)
    if not use.calibrated:
        _log.warning(
            "uncalibrated: probabilities were not calibrated for these settings (%s)",
            "; ".join(use.differences),
        )
    return calibration, use


def _still_findings(
    reconstruction: Reconstruction, positions: Array, effects: Sequence[Effect], settings: DiagnosisSettings
) -> dict[str, Finding]:
    """Findings from the outline of frame 0, brightness, sharpness and the paths of the pinned vertices."""
    scene = reconstruction.scene
    outline = template_outline(scene, settings.outline)
    seen = measured_brightness(reconstruction, positions, settings.brightness)
    findings = {}
    for effect in effects:
        fit: OutlineFit | BrightnessFit | ExposureFit | SlipFit
        if isinstance(effect, CameraEffect | MaskEffect):
            fit = outline_evidence(effect, scene, outline, settings.outline)
        elif isinstance(effect, BrightnessEffect):
            fit = brightness_evidence(effect, seen, settings.brightness)
        elif isinstance(effect, ExposureEffect):
            fit = exposure_evidence(effect, smear(reconstruction, positions, settings.exposure))
        elif isinstance(effect, AnchorSlip):
            pinned = list(scene.pinned_vertices)
            pull = positions[0].mean(0) - positions[0][pinned]
            fit = slip_evidence(effect, positions[:, pinned], scene.fps, pull, settings.attachment_slip)
        else:
            continue
        findings[effect.NAME] = finding(effect, fit.log_evidence, fit.mean, fit.covariance)
    return findings


def _start_stiffness(reconstruction: Reconstruction, stiffness: tuple[float, float, float]) -> None:
    """Track with the same fabric whatever the scene's grid."""
    p = reconstruction.parameters
    cell = p.units.length**2
    values = torch.tensor([stiffness[0], stiffness[1] * cell, stiffness[2]], dtype=torch.float64)
    p.set_stiffness((values / p.stiffness_units).tolist())


def _write_arrays(path: Path, arrays: dict[str, Array]) -> None:
    with written_atomically(path) as temporary:
        np.savez_compressed(temporary, **arrays)  # type: ignore[arg-type]


def _write_array(path: Path, array: NDArray[np.floating]) -> None:
    with written_atomically(path) as temporary:
        np.save(temporary, array)
