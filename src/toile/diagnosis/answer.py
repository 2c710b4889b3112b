"""From what the stages have found to probabilities, and to the report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from toile.diagnosis.decision import UNKNOWN, Calibration, Weights, probabilities, tempered
from toile.diagnosis.findings import Finding, Screening, finding
from toile.diagnosis.refits import Race
from toile.diagnosis.stages import WindowPredictions
from toile.effects.base import Effect


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
    seen: Mapping[str, Finding],
    screening: Screening,
    race: Race,
    predictions: WindowPredictions,
    effects: Mapping[str, Effect],
    *,
    step_error: float,
    used: int,
    usual_cost: float,
    weights: Weights,
    calibration: Calibration,
) -> Weighed:
    """Put together what all stages say of every candidate.

    Args:
        seen: findings without a model of the motion.
        screening: to first order.
        race: refits.
        predictions: by those.
        effects: that move the cloth, by name.
        step_error: what half the time step changes, over the cloth's width.
        used: frames fitted.
        usual_cost: of the images that a right model leaves, per fitted frame.
        weights: what counts for how much.
        calibration: see Calibration.
    """
    findings = dict(seen)
    for name, screened in screening.findings.items():
        if name in race.effects:
            model = race.effects[name]
            gained = model.gained - screening.penalties[name]
            findings[name] = finding(effects[name], gained, model.mean, model.covariance)
        else:
            # What has not been tried, or could not reach its score, speaks for nothing.
            findings[name] = replace(screened, log_evidence=min(screened.log_evidence, 0.0))
    evidence = {name: found.log_evidence for name, found in findings.items()}
    left = min(model.image_cost for model in (race.base, *race.effects.values())) / used
    for name in screening.findings:
        gain = predictions.gains.get(name, 0.0)
        size = predictions.sizes.get(name, np.inf)
        counted = weights.combined(findings[name].log_evidence, gain, size, step_error)
        evidence[name] = tempered(counted, left, usual_cost)
    # What is unknown predicts nothing, better or worse.
    unknown = weights.combined(race.beyond, 0.0)
    chances = probabilities({**evidence, UNKNOWN: unknown}, calibration)
    return Weighed(findings, evidence, left, chances)


def best_scoring(screening: Screening, least: float) -> dict[str, tuple[int, ...]]:
    """Free numbers of the effects that are worth a fit of their own, the best-scoring first.

    Args:
        screening: to first order.
        least: log evidence of an effect that is.
    """
    scores = {name: found.log_evidence for name, found in screening.findings.items()}
    names: Sequence[str] = sorted(scores, key=lambda name: -scores[name])
    return {name: screening.free[name] for name in names if screening.free[name] and scores[name] > least}
