"""The diagnosis of one clip, from its images to a verdict."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field

from toile.atomic_file import written_atomically
from toile.diagnosis.aliases import alias_of
from toile.diagnosis.border import BorderFit, BorderSettings, border, border_evidence
from toile.diagnosis.colours import ColourFit, ColourSettings, brightness_evidence, colours
from toile.diagnosis.continuity import Discrepancy
from toile.diagnosis.decision import UNKNOWN, Calibration, Weights, probabilities, tempered
from toile.diagnosis.effect_size import effect_size
from toile.diagnosis.evidence import EvidenceSettings
from toile.diagnosis.findings import (
    WIDENED,
    Finding,
    Screening,
    estimates,
    finding,
    mechanical_findings,
    naive_answer,
)
from toile.diagnosis.gap_maps import gap_maps, stage_shares
from toile.diagnosis.grip import GripSettings, SlipFit, slip_evidence
from toile.diagnosis.made_with import MADE_WITH_FILE, MadeWith
from toile.diagnosis.mechanics import analyse_mechanics
from toile.diagnosis.model_grid import model_grids
from toile.diagnosis.numerics import StepRefinement, time_step_error
from toile.diagnosis.refits import RefitSettings, refits, settled
from toile.diagnosis.sharpness import ExposureFit, ExposureSettings, exposure_evidence, smear
from toile.diagnosis.shooting import ShootingSettings
from toile.diagnosis.shrinkage import PredictionSettings, held_out_shrinks, prediction_gains
from toile.diagnosis.stage_times import TIMES_FILE, StageTimes
from toile.diagnosis.tracked import CoarseTracking, point_settings, track, tracked_motion
from toile.diagnosis.verdict import VerdictSettings, until, verdict_of
from toile.diagnosis.workers import ALONE, Workers
from toile.effects.anchor_slip import AnchorSlip
from toile.effects.base import BrightnessEffect, CameraEffect, Effect, ExposureEffect, MaskEffect
from toile.effects.catalogue import STAGES
from toile.errors import InputError
from toile.evaluation.diagnosis_record import CalibrationUse, EffectReport, GapReport, Protocol, Where
from toile.fitting.gauss_newton.recipe import TrackingRecipe
from toile.fitting.lost_cloth import LEAST, first_lost, outline_overlap
from toile.fitting.reconstruction import Reconstruction
from toile.limits import Count, CountOrZero, Fraction, Positive, Seed, Unit
from toile.scenes.scene import Scene

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]
"""Called with what is being done and the share that is done."""

Side = Annotated[int, Field(ge=3)]
"""Vertices along a side of a grid."""

_log = logging.getLogger(__name__)

TRACKED_FILE = "tracked.npz"
VERTICES_FILE = "gap_vertices.npy"
FRAMES_FILE = "gap_frames_vertices.npy"
SCREENING_FILE = "screening.npz"
HELD_OUT_FILE = "held_out.npz"
"""Predicted positions of the held-out frames on the scene's grid, by what was in the model."""


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
        refitted: how many effects that move the cloth are fitted on their own, the most promising first: in a
            first pass, in a second one, and so on.
        settling_passes: of the base model at most, with forces of the size that it needs.
        weights: what evidence from fitted windows and that prediction count for.
        compared: effects whose prediction of held-out frames is measured.
        placebos: force fields without meaning that are fitted and predicted beside them.
        seed: of everything random.
        fewest_frames: that are fitted at least, whatever is held out or lost.
        least_overlap: of the outline with the mask, as a share of frame 0's; with less the cloth is lost.
        border: camera and mask, see BorderSettings.
        colours: light, see ColourSettings.
        exposure: see ExposureSettings.
        grip: see GripSettings.
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
    settling_passes: CountOrZero = 4
    weights: Weights = field(default_factory=Weights)
    compared: CountOrZero = 3
    placebos: CountOrZero = 3
    seed: Seed = 0
    fewest_frames: Annotated[Count, Unit("frames")] = 6
    least_overlap: Fraction = LEAST
    border: BorderSettings = field(default_factory=BorderSettings)
    colours: ColourSettings = field(default_factory=ColourSettings)
    exposure: ExposureSettings = field(default_factory=ExposureSettings)
    grip: GripSettings = field(default_factory=GripSettings)
    evidence: EvidenceSettings = field(default_factory=EvidenceSettings)
    refits: RefitSettings = field(default_factory=RefitSettings)
    prediction: PredictionSettings = field(default_factory=PredictionSettings)
    widened: Positive = WIDENED
    verdict: VerdictSettings = field(default_factory=VerdictSettings)
    calibration: str | None = None


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
    """Diagnose a clip; arrays go into the folder, and what has been tracked there before is used again.

    Args:
        reconstruction: the scene with its cloth and free forces; changed in place.
        recipe: tracks the motion; its last stage is used.
        effects: candidates.
        settings: see DiagnosisSettings.
        folder: of the run.
        progress: called with what is being done and the share that is done.
        workers: share what can be done side by side.
        made_with: all settings that matter, those of tracking among them; None if nobody knows: then
            probabilities are uncalibrated.

    Returns:
        The report; the caller writes it.

    Raises:
        InputError: the frames are unevenly spaced.
    """
    _require_even_spacing(reconstruction.scene)
    calibration, use = _calibration(settings, made_with, folder)
    torch.manual_seed(settings.seed)
    scene = reconstruction.scene
    n_frames = scene.n_frames
    used = max(settings.fewest_frames, n_frames - round(settings.held_out * n_frames))
    _start_stiffness(reconstruction, settings.stiffness)
    times = StageTimes()
    with times.stage("tracking"):
        positions, cached = _tracked_positions(
            reconstruction, recipe, settings.coarse, used, folder, progress, settings.least_overlap
        )
        # What comes after that is no motion of this cloth.
        kept = first_lost(outline_overlap(reconstruction, positions), settings.least_overlap)
        known = max(settings.fewest_frames, kept)
        used = min(used, known)
    if cached:
        times.from_cache("tracking")
    times.write(folder / TIMES_FILE)
    progress("what the images say", 0.45)
    with times.stage("images"):
        points = point_settings(recipe)
        levels = [
            (grid, tracked_motion(reconstruction, positions, grid, points, settings.seed))
            for grid in model_grids(scene, reconstruction.cloth, settings.sides)
        ]
        findings = _still_findings(reconstruction, positions[:used], effects, settings)
    progress("base model", 0.5)
    done = [0]

    def count(what: str, cost: float) -> None:
        done[0] += 1
        progress(f"base model, cost {cost:.0f}", min(0.5 + 0.025 * done[0], 0.85))

    with times.stage("base model and evidence"):
        mechanics = analyse_mechanics(
            scene,
            levels,
            effects,
            settings.shooting,
            settings.stiffness,
            settings.longest_substep,
            used,
            count,
            workers,
            settings.refinement,
            settings.evidence,
        )
    progress("base model, settled", 0.85)
    with times.stage("refits"):
        usual = settings.usual_discrepancy
        best = settled(mechanics, scene.camera, usual, settings.settling_passes, workers, settings.refits)
        screened = mechanical_findings(best, usual)
        base, models = refits(
            best,
            _promising(screened, settings.refits.promising),
            screened.charges,
            usual,
            settings.refitted,
            lambda what, share: progress(what, 0.86 + 0.06 * share),
            workers,
            settings.refits,
        )
    for name, screening in screened.findings.items():
        if name in models:
            model = models[name]
            gained = model.gained - screened.charges[name]
            findings[name] = finding(mechanics.effects[name], gained, model.mean, model.covariance)
        else:
            # What has not been tried, or could not keep its promise, speaks for nothing.
            findings[name] = replace(screening, log_evidence=min(screening.log_evidence, 0.0))
    progress("what the effects foretell", 0.92)
    with times.stage("foretelling"):
        gains = prediction_gains(mechanics, base, models, workers, settings.prediction)
        width = mechanics.around.cloth_size[0]
        sizes = {name: effect_size(mechanics, model) / width for name, model in models.items()}
    with times.stage("numerics"):
        step_error = time_step_error(mechanics.shooting, mechanics.fit)
    evidence = {name: found.log_evidence for name, found in findings.items()}
    left = min(model.image_cost for model in (base, *models.values())) / used
    for name in screened.findings:
        fitted, foretold = findings[name].log_evidence, gains.get(name, 0.0)
        counted = settings.weights.combined(fitted, foretold, sizes.get(name, np.inf), step_error / width)
        evidence[name] = tempered(counted, left, settings.usual_cost)
    # What is unknown foretells nothing, better or worse.
    missing = base.evidence.posterior(())
    beyond = missing.log_evidence - base.evidence.posterior((), usual).log_evidence
    unknown = settings.weights.combined(beyond, 0.0)
    chances = probabilities({**evidence, UNKNOWN: unknown}, calibration)
    ranked = [name for name in chances if name in findings]
    progress("held-out frames", 0.95)
    with times.stage("held-out frames"):
        compared = [name for name in ranked if name in models][: settings.compared]
        held_out = held_out_shrinks(
            mechanics,
            base,
            {name: models[name] for name in compared},
            used=used,
            known=known,
            horizon=settings.shooting.window,
            n_placebos=settings.placebos,
            seed=settings.seed,
            settings=settings.prediction,
        )
    progress("maps", 0.97)
    with times.stage("maps"):
        maps = gap_maps(mechanics)
    numerics = min(1.0, step_error / max(maps.mean, 1e-9))
    times.write(folder / TIMES_FILE)
    prolong = levels[-1][0].prolong
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
            "names": np.array(list(evidence)),
            "log_evidence": np.array(list(evidence.values())),
            "first_order": np.array(
                [screened.findings[n].log_evidence if n in screened.findings else np.nan for n in findings]
            ),
            "hindsight": np.array([found.log_evidence for found in findings.values()]),
            "foretold": np.array([gains.get(name, np.nan) for name in findings]),
            "size": np.array([sizes.get(name, np.nan) for name in findings]),  # over the cloth's width
            "unknown": np.array(beyond),
            "left": np.array(left),
            "discrepancy": np.array(missing.discrepancy),  # internal, external
            "base": mechanics.fit.values,
            "time_step_error": np.array(step_error),
            "width": np.array(width),
            "costs": np.array(mechanics.fit.history),
        },
    )
    by_name = {effect.NAME: effect for effect in effects}
    explained = left <= settings.usual_cost
    verdict = verdict_of(
        chances, evidence, calibration, held_out.shrinks, explained=explained, settings=settings.verdict
    )
    return GapReport(
        until(verdict, known) if known < n_frames else verdict,
        Where(stage_shares(evidence, calibration, numerics), maps.frames, VERTICES_FILE, maps.regimes),
        tuple(
            EffectReport(
                name,
                STAGES[name].value,
                chances[name],
                estimates(findings[name], by_name[name], settings.widened),
                held_out.shrinks.get(name),
            )
            for name in ranked
        ),
        alias_of(best, missing.discrepancy, calibration, settings.weights),
        Protocol(
            settings.seed,
            tuple(range(used)),
            tuple(range(used, n_frames)),
            f"toile {version('toile')}",
            naive_answer(best, findings),
        ),
        use,
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
    """Findings from the outline of frame 0, brightness, sharpness and the paths of the held vertices."""
    scene = reconstruction.scene
    outline = border(scene, settings.border)
    seen = colours(reconstruction, positions, settings.colours)
    findings = {}
    for effect in effects:
        fit: BorderFit | ColourFit | ExposureFit | SlipFit
        if isinstance(effect, CameraEffect | MaskEffect):
            fit = border_evidence(effect, scene, outline, settings.border)
        elif isinstance(effect, BrightnessEffect):
            fit = brightness_evidence(effect, seen, settings.colours)
        elif isinstance(effect, ExposureEffect):
            fit = exposure_evidence(effect, smear(reconstruction, positions, settings.exposure))
        elif isinstance(effect, AnchorSlip):
            held = list(scene.held_vertices)
            pull = positions[0].mean(0) - positions[0][held]
            fit = slip_evidence(effect, positions[:, held], scene.fps, pull, settings.grip)
        else:
            continue
        findings[effect.NAME] = finding(effect, fit.log_evidence, fit.mean, fit.covariance)
    return findings


def _promising(screened: Screening, least: float) -> dict[str, tuple[int, ...]]:
    """Free numbers of the effects that are worth a fit of their own, the most promising first."""
    promise = {name: found.log_evidence for name, found in screened.findings.items()}
    names = sorted(promise, key=lambda name: -promise[name])
    return {name: screened.free[name] for name in names if screened.free[name] and promise[name] > least}


def _tracked_positions(
    reconstruction: Reconstruction,
    recipe: TrackingRecipe,
    coarse: CoarseTracking | None,
    used: int,
    folder: Path,
    progress: Progress,
    least_overlap: float,
) -> tuple[Array, bool]:
    """Frame positions (F, N, 3) [m], and whether they come from the folder."""
    path = folder / TRACKED_FILE
    if path.exists():
        with np.load(path) as stored:
            if int(stored["used"]) == used:
                return np.asarray(stored["positions"]), True
    n_frames = reconstruction.scene.n_frames

    def report(frame: int, share: float) -> None:
        progress(f"tracking, frame {frame} of {n_frames}", 0.45 * share)

    positions = track(reconstruction, recipe, coarse, used, report, least_overlap)
    _write_arrays(path, {"positions": positions, "used": np.array(used)})
    return positions, False


def _start_stiffness(reconstruction: Reconstruction, stiffness: tuple[float, float, float]) -> None:
    """Track with the same fabric whatever the scene's grid."""
    p = reconstruction.parameters
    cell = p.units.length**2
    units = (p.units.stretching, p.units.energy, p.units.energy)
    values = (stiffness[0], stiffness[1] * cell, stiffness[2])
    with torch.no_grad():
        for name, value, unit in zip(p.STIFFNESSES, values, units, strict=True):
            p.get_parameter(name).fill_(value / unit)


def _write_arrays(path: Path, arrays: dict[str, Array]) -> None:
    with written_atomically(path) as temporary:
        np.savez_compressed(temporary, **arrays)  # type: ignore[arg-type]


def _write_array(path: Path, array: NDArray[np.floating]) -> None:
    with written_atomically(path) as temporary:
        np.save(temporary, array)
