"""From what the stages have found to probabilities."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from toile.diagnosis.decision import UNKNOWN, Calibration, probabilities, tempered
from toile.diagnosis.findings import Finding, Screening, finding
from toile.diagnosis.mechanics import Mechanics
from toile.diagnosis.problem import DiagnosisProblem
from toile.diagnosis.refits import Race
from toile.diagnosis.results import ConvergedBase, Seen, StepError, WindowPredictions


@dataclass(frozen=True)
class Weighed:
    """What speaks for every hypothesis.

    Attributes:
        findings: of every candidate.
        evidence: log evidence that counts, by candidate.
        left: cost of the images that the best model leaves, per fitted frame.
        chances: probabilities, NONE and UNKNOWN among them, most probable first.
    """

    findings: dict[str, Finding]
    evidence: dict[str, float]
    left: float
    chances: dict[str, float]

    @property
    def ranked(self) -> list[str]:
        """Candidates, most probable first."""
        return [name for name in self.chances if name in self.findings]


def weighed(
    problem: DiagnosisProblem,
    mechanics: Mechanics,
    seen: Seen,
    converged: ConvergedBase,
    race: Race,
    predictions: WindowPredictions,
    step_error: StepError,
    calibration: Calibration,
) -> Weighed:
    """Put together what all stages say of every candidate.

    Args:
        problem: the clip.
        mechanics: around the base model.
        seen: findings without a model of the motion.
        converged: effects to first order.
        race: refits.
        predictions: by those.
        step_error: what half the time step changes.
        calibration: see Calibration.
    """
    settings, screening, effects = problem.settings, converged.screening, mechanics.effects
    findings = dict(seen.findings)
    for name, screened in screening.findings.items():
        if name in race.effects:
            model = race.effects[name]
            gained = model.gained - screening.penalties[name]
            findings[name] = finding(effects[name], gained, model.mean, model.covariance)
        else:
            # What has not been tried, or could not reach its score, speaks for nothing.
            findings[name] = replace(screened, log_evidence=min(screened.log_evidence, 0.0))
    evidence = {name: found.log_evidence for name, found in findings.items()}
    left = min(model.image_cost for model in (race.base, *race.effects.values())) / problem.n_used(seen)
    for name in screening.findings:
        gain = predictions.gains.get(name, 0.0)
        size = predictions.sizes.get(name, np.inf)
        own = findings[name].log_evidence
        counted = settings.weights.combined(own, gain, size, step_error.distance / mechanics.width)
        evidence[name] = tempered(counted, left, settings.usual_cost)
    # What is unknown predicts nothing, better or worse.
    unknown = settings.weights.combined(race.beyond, 0.0)
    chances = probabilities({**evidence, UNKNOWN: unknown}, calibration)
    return Weighed(findings, evidence, left, chances)


def best_scoring(screening: Screening, least: float) -> dict[str, tuple[int, ...]]:
    """Free coefficients of the effects that are worth a fit of their own, the best-scoring first.

    Args:
        screening: to first order.
        least: log evidence of an effect that is.
    """
    scores = {name: found.log_evidence for name, found in screening.findings.items()}
    names: Sequence[str] = sorted(scores, key=lambda name: -scores[name])
    return {name: screening.free[name] for name in names if screening.free[name] and scores[name] > least}
