"""The diagnosis of one clip, from its images to a verdict, stage by stage."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

from toile.denormals import denormals_flushed
from toile.diagnosis.answer import weighed
from toile.diagnosis.arrays import write_arrays
from toile.diagnosis.decision import Calibration
from toile.diagnosis.made_with import MADE_WITH_FILE, MadeWith
from toile.diagnosis.pipeline import Pipeline, Progress
from toile.diagnosis.problem import DiagnosisProblem
from toile.diagnosis.record import CalibrationUse, GapReport
from toile.diagnosis.report import gap_report
from toile.diagnosis.results import KINDS, StageResults
from toile.diagnosis.settings import DiagnosisSettings
from toile.diagnosis.stage_store import StageStore
from toile.diagnosis.stage_times import TIMES_FILE, StageTimes
from toile.diagnosis.stages import DiagnosisStages
from toile.diagnosis.stored_values import ValueStore
from toile.effects.base import Effect
from toile.reconstruction.gauss_newton.recipe import TrackingRecipe
from toile.reconstruction.problem import Reconstruction
from toile.workers import ALONE, Workers

_log = logging.getLogger(__name__)


@denormals_flushed()
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
    problem = DiagnosisProblem(reconstruction, recipe, effects, settings)
    calibration, use = _calibration(settings, made_with, folder)
    stages = DiagnosisStages(problem, progress, workers)
    times = StageTimes.going_on(folder / TIMES_FILE)
    run = Pipeline(StageStore(folder, ValueStore(KINDS, problem.effects), times), progress).run

    tracked = run(stages.tracking())
    seen = run(stages.image_cues(), tracked)
    used = problem.n_used(seen)
    base = run(stages.base_model(used), tracked)
    converged = run(stages.converged_base(), tracked, base)
    race = run(stages.refits(), tracked, base, converged)
    predictions = run(stages.window_predictions(), tracked, base, race)
    step_error = run(stages.numerics(), tracked, base)
    mechanics = problem.mechanics(tracked, base)
    judged = weighed(problem, mechanics, seen, converged, race, predictions, step_error, calibration)
    compared = [name for name in judged.ranked if name in race.effects][: settings.compared]
    held_out = run(stages.held_out(compared, used), tracked, seen, base, race)
    maps = run(stages.maps(), tracked, base)

    progress("answer", 0.99)
    found = StageResults(tracked, seen, used, base, converged, race, predictions, step_error, held_out, maps)
    write_arrays(problem, found, judged, folder)
    return gap_report(problem, found, judged, calibration, use)


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
