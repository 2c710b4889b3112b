"""The stages of a diagnosis: what each does, where its result lies, and what it depends on."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, TypeVar, TypeVarTuple

import torch

from toile.diagnosis.answer import best_scoring
from toile.diagnosis.effect_size import effect_size
from toile.diagnosis.findings import mechanical_findings
from toile.diagnosis.fingerprint import fingerprint
from toile.diagnosis.gap_maps import GapMaps, gap_maps
from toile.diagnosis.image_cues import image_findings
from toile.diagnosis.mechanics import analyse_mechanics
from toile.diagnosis.numerics import time_step_error
from toile.diagnosis.pipeline import PipelineStage, Progress
from toile.diagnosis.problem import DiagnosisProblem
from toile.diagnosis.refits import Race, converged, refits
from toile.diagnosis.results import (
    BaseModel,
    ConvergedBase,
    Seen,
    StepError,
    TrackedMotion,
    WindowPredictions,
)
from toile.diagnosis.shrinkage import HeldOut, held_out_shrinks, prediction_gains
from toile.diagnosis.tracked import track
from toile.physics.frame_steps import fewest_substeps
from toile.reconstruction.lost_cloth import first_lost, outline_overlap
from toile.workers import ALONE, Workers

Inputs = TypeVarTuple("Inputs")
Output = TypeVar("Output")

TRACKING = "tracking"
IMAGES = "images"
BASE_MODEL = "base model and evidence"
CONVERGED_BASE = "converged base model"
REFITS = "refits"
WINDOW_PREDICTIONS = "window predictions"
NUMERICS = "numerics"
HELD_OUT = "held-out frames"
MAPS = "maps"
ANSWER = "answer"

FILES = {
    TRACKING: "tracked.npz",
    IMAGES: "stages/images.npz",
    BASE_MODEL: "stages/base_model.npz",
    CONVERGED_BASE: "stages/converged_base.npz",
    REFITS: "stages/refits.npz",
    WINDOW_PREDICTIONS: "stages/window_predictions.npz",
    NUMERICS: "stages/numerics.npz",
    HELD_OUT: "stages/held_out.npz",
    MAPS: "stages/maps.npz",
}
"""Where the results of the stages lie in the folder of a run; the answer follows from them at once."""
TRACKED_FILE = FILES[TRACKING]

_ORDER = (*FILES, ANSWER)

# Stage that asks for a setting first; it and those after it depend on it. What is not listed counts from the
# first stage on, so a setting that somebody forgets here costs time and is never overlooked.
_FIRST_ASKED = {
    "outline": IMAGES,
    "brightness": IMAGES,
    "exposure": IMAGES,
    "attachment_slip": IMAGES,
    "sides": BASE_MODEL,
    "shooting": BASE_MODEL,
    "longest_substep": BASE_MODEL,
    "refinement": BASE_MODEL,
    "usual_discrepancy": CONVERGED_BASE,
    "base_refits": CONVERGED_BASE,
    "evidence": CONVERGED_BASE,
    "refits": CONVERGED_BASE,
    "refitted": REFITS,
    "prediction": WINDOW_PREDICTIONS,
    "placebos": HELD_OUT,
    "compared": ANSWER,  # the stage of the held-out frames is told the names
    "weights": ANSWER,
    "usual_cost": ANSWER,
    "widened": ANSWER,
    "verdict": ANSWER,
    "calibration": ANSWER,
}


def settings_of(stage: str, settings: Any) -> Mapping[str, str]:
    """Fingerprints of the settings (a dataclass) that a stage, or one before it, asks for."""
    asked = _ORDER[: _ORDER.index(stage) + 1]
    return {
        f"settings.{f.name}": fingerprint(getattr(settings, f.name))
        for f in fields(settings)
        if _FIRST_ASKED.get(f.name, TRACKING) in asked
    }


@dataclass(frozen=True)
class DiagnosisStages:
    """The stages of one clip's diagnosis.

    Attributes:
        problem: the clip.
        progress: called with what is being done and the share that is done.
        workers: share what can be done side by side.
    """

    problem: DiagnosisProblem
    progress: Progress
    workers: Workers = ALONE

    def tracking(self) -> PipelineStage[TrackedMotion]:
        """Positions of all frames, with free forces."""
        problem, settings = self.problem, self.problem.settings
        parameters, n_frames = problem.reconstruction.parameters, problem.scene.n_frames

        def report(frame: int, share: float) -> None:
            self.progress(f"tracking, frame {frame} of {n_frames}", 0.45 * share)

        def compute() -> TrackedMotion:
            start = {name: value.clone() for name, value in parameters.state_dict().items()}
            torch.manual_seed(settings.seed)
            found = track(
                problem.reconstruction,
                problem.recipe,
                settings.coarse,
                problem.n_fitted,
                report,
                settings.least_overlap,
            )
            # Nothing that comes after may hang on whether tracking has just been done.
            parameters.load_state_dict(start)
            return TrackedMotion(found)

        return self._stage(TRACKING, "tracking", 0.0, TrackedMotion, compute)

    def image_cues(self) -> PipelineStage[TrackedMotion, Seen]:
        """How far tracking keeps the cloth, and traces that are no motion."""
        problem, settings = self.problem, self.problem.settings

        def compute(tracked: TrackedMotion) -> Seen:
            reconstruction, positions = problem.reconstruction, tracked.positions
            # What comes after that is no motion of this cloth.
            kept = first_lost(outline_overlap(reconstruction, positions), settings.least_overlap)
            known = max(settings.fewest_frames, kept)
            # Said here, where its time belongs.
            problem.levels(tracked)
            seen = positions[: min(problem.n_fitted, known)]
            return Seen(known, image_findings(reconstruction, seen, problem.effects, settings))

        return self._stage(IMAGES, "what the images say", 0.45, Seen, compute, problem.candidates)

    def base_model(self, used: int) -> PipelineStage[TrackedMotion, BaseModel]:
        """Stiffness, wind, starts, boundary positions and forces of all windows of the used frames."""
        problem, settings = self.problem, self.problem.settings
        scene, done = problem.scene, [0]

        def count(what: str, cost: float) -> None:
            done[0] += 1
            self.progress(f"base model, cost {cost:.0f}", min(0.5 + 0.025 * done[0], 0.85))

        def compute(tracked: TrackedMotion) -> BaseModel:
            found = analyse_mechanics(
                scene,
                problem.levels(tracked),
                problem.effects,
                settings.shooting,
                settings.stiffness,
                settings.longest_substep,
                used,
                count,
                self.workers,
                settings.refinement,
                settings.evidence,
            )
            finer = found.shooting.substeps // fewest_substeps(1 / scene.fps, settings.longest_substep)
            return BaseModel(found.fit, finer.bit_length() - 1, found.evidence.systems)

        # Whoever the candidates are: the base model hangs on the fitted frames only.
        frames = {"fitted frames": fingerprint(used)}
        return self._stage(BASE_MODEL, "base model", 0.5, BaseModel, compute, frames)

    def converged_base(self) -> PipelineStage[TrackedMotion, BaseModel, ConvergedBase]:
        """The base model with forces of the size that it needs, and effects to first order around it."""
        problem, settings = self.problem, self.problem.settings

        def compute(tracked: TrackedMotion, base: BaseModel) -> ConvergedBase:
            best = converged(
                problem.mechanics(tracked, base),
                problem.scene.camera,
                settings.usual_discrepancy,
                settings.base_refits,
                self.workers,
                settings.refits,
            )
            screening = mechanical_findings(best, settings.usual_discrepancy)
            return ConvergedBase(best.fit, best.evidence.systems, screening)

        doing = "base model, refitted to convergence"
        return self._stage(CONVERGED_BASE, doing, 0.85, ConvergedBase, compute, problem.candidates)

    def refits(self) -> PipelineStage[TrackedMotion, BaseModel, ConvergedBase, Race]:
        """Well-scoring effects at their own best fits."""
        problem, settings = self.problem, self.problem.settings

        def compute(tracked: TrackedMotion, base: BaseModel, found: ConvergedBase) -> Race:
            return refits(
                problem.converged_mechanics(tracked, base, found),
                best_scoring(found.screening, settings.refits.least_score),
                found.screening.penalties,
                settings.usual_discrepancy,
                settings.refitted,
                lambda what, share: self.progress(what, 0.86 + 0.06 * share),
                self.workers,
                settings.refits,
            )

        return self._stage(REFITS, "refits", 0.86, Race, compute, problem.candidates)

    def window_predictions(self) -> PipelineStage[TrackedMotion, BaseModel, Race, WindowPredictions]:
        """What refitted effects predict of every window, and how far they move the cloth."""
        problem = self.problem

        def compute(tracked: TrackedMotion, base: BaseModel, race: Race) -> WindowPredictions:
            mechanics, prediction = problem.mechanics(tracked, base), problem.settings.prediction
            gains = prediction_gains(mechanics, race.base, race.effects, self.workers, prediction)
            sizes = {
                name: effect_size(mechanics, model) / mechanics.width for name, model in race.effects.items()
            }
            return WindowPredictions(gains, sizes)

        doing = "what the effects predict"
        return self._stage(WINDOW_PREDICTIONS, doing, 0.92, WindowPredictions, compute, problem.candidates)

    def numerics(self) -> PipelineStage[TrackedMotion, BaseModel, StepError]:
        """What half the time step changes."""

        def compute(tracked: TrackedMotion, base: BaseModel) -> StepError:
            mechanics = self.problem.mechanics(tracked, base)
            return StepError(time_step_error(mechanics.shooting, mechanics.fit))

        return self._stage(NUMERICS, "time steps of half the length", 0.94, StepError, compute)

    def held_out(
        self, compared: Sequence[str], used: int
    ) -> PipelineStage[TrackedMotion, Seen, BaseModel, Race, HeldOut]:
        """Open rollouts over frames that no fit has seen, with the effects that are compared."""
        problem, settings = self.problem, self.problem.settings

        def compute(tracked: TrackedMotion, seen: Seen, base: BaseModel, race: Race) -> HeldOut:
            return held_out_shrinks(
                problem.mechanics(tracked, base),
                race.base,
                {name: race.effects[name] for name in compared},
                used=used,
                known=seen.known,
                horizon=settings.shooting.window,
                n_placebos=settings.placebos,
                seed=settings.seed,
                settings=settings.prediction,
            )

        others = {**problem.candidates, "compared effects": fingerprint(list(compared))}
        return self._stage(HELD_OUT, "held-out frames", 0.95, HeldOut, compute, others)

    def maps(self) -> PipelineStage[TrackedMotion, BaseModel, GapMaps]:
        """Where the base model departs from the tracked motion."""

        def compute(tracked: TrackedMotion, base: BaseModel) -> GapMaps:
            return gap_maps(self.problem.mechanics(tracked, base))

        return self._stage(MAPS, "maps", 0.97, GapMaps, compute)

    def _stage(
        self,
        name: str,
        doing: str,
        share: float,
        output: type[Output],
        compute: Callable[[*Inputs], Output],
        others: Mapping[str, str] | None = None,
    ) -> PipelineStage[*Inputs, Output]:
        """A stage that is made from the problem, the settings that it asks for, and more."""
        made_from = {**self.problem.made_from, **settings_of(name, self.problem.settings), **(others or {})}
        return PipelineStage(name, FILES[name], doing, share, output, compute, made_from)
