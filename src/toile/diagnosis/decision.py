"""From evidence to probabilities, calibrated on scenes made for it, and a confidence set."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files

import numpy as np

NONE = "none"
UNKNOWN = "unknown"


@dataclass(frozen=True)
class Weights:
    """What hindsight and foresight count for, with effects that move the cloth and what is unknown.

    Attributes:
        hindsight: share of the log evidence from fitted windows that counts.
        most: log evidence beyond which more says nothing: it comes from an error that the effect takes up.
        foresight: log evidence for each logarithm by which windows are foretold better.
        farthest: logarithm beyond which better says nothing.
        smallest: size of an effect, over the cloth's width, from which on what speaks for it counts in full,
            and error of the time step up to which it does; see effect_size and time_step_error.
    """

    hindsight: float = 0.5
    most: float = 60.0
    foresight: float = 20.0
    farthest: float = 0.5
    smallest: float = 0.005

    def combined(self, evidence: float, gain: float, size: float = np.inf, numerics: float = 0.0) -> float:
        """Log evidence that counts.

        Args:
            evidence: from fitted windows.
            gain: logarithm by which windows are foretold better.
            size: how far the effect moves the cloth, over the cloth's width.
            numerics: how far half the time step does.
        """
        foreseen = float(np.clip(gain, -self.farthest, self.farthest))
        value = self.hindsight * min(evidence, self.most) + self.foresight * foreseen
        if value <= 0:
            return value
        share = min(1.0, size / self.smallest) * (self.smallest / max(numerics, self.smallest))
        return value * share**2


def tempered(evidence: float, left: float, usual: float) -> float:
    """Log evidence for an effect that moves the cloth, on a clip that even the best model explains badly.

    What a model is wrong by is then no noise, and evidence counts it as if it were: the likelihood is raised
    to a power below one (Bissiri, Holmes and Walker 2016, a general framework for updating beliefs).

    Args:
        evidence: that counts, see Weights.combined.
        left: cost of the images that the best model leaves, per fitted frame.
        usual: what a right model leaves.
    """
    return evidence * usual / left if evidence > 0 and left > usual else evidence


@dataclass(frozen=True)
class Calibration:
    """What scenes without an effect, and with known ones, say about the evidence.

    Attributes:
        usual: log evidence that an effect reaches on scenes without any, by name.
        spread: deviation of that.
        temperature: deviations of the null by which the odds of an effect grow e-fold.
        threshold: deviations at which an effect and none are equally probable.
        unknown: deviations at which something outside the catalogue and none are.
        source: scenes it was made from.
    """

    usual: Mapping[str, float]
    spread: Mapping[str, float]
    temperature: float
    threshold: float
    unknown: float
    source: str

    @staticmethod
    def load() -> Calibration:
        """The calibration that comes with the package."""
        values = json.loads((files("toile.diagnosis") / "calibration.json").read_text())
        return Calibration(**values)

    def score(self, name: str, log_evidence: float) -> float:
        """Log evidence in deviations above what is usual without the effect.

        What is usually against an effect does not speak for it where it is missing: a clip that says nothing
        scores 0.
        """
        usual = max(self.usual.get(name, 0.0), 0.0)
        return (log_evidence - usual) / max(self.spread.get(name, 1.0), 1.0)


def probabilities(evidence: Mapping[str, float], calibration: Calibration) -> dict[str, float]:
    """Probability of every hypothesis, NONE and UNKNOWN among them, most probable first.

    Args:
        evidence: log evidence against the base model, by effect and for UNKNOWN.
        calibration: see Calibration.
    """
    logits = {NONE: 0.0}
    for name, value in evidence.items():
        at = calibration.unknown if name == UNKNOWN else calibration.threshold
        logits[name] = (calibration.score(name, value) - at) / calibration.temperature
    names = list(logits)
    values = np.array([logits[name] for name in names])
    weights = np.exp(values - values.max())
    weights /= weights.sum()
    order = np.argsort(-weights, kind="stable")
    return {names[i]: float(weights[i]) for i in order}


def confidence_set(found: Mapping[str, float], level: float = 0.9) -> tuple[str, ...]:
    """The most probable hypotheses that hold ``level`` of the probability together."""
    chosen: list[str] = []
    total = 0.0
    for name, value in sorted(found.items(), key=lambda item: -item[1]):
        chosen.append(name)
        total += value
        if total >= level:
            break
    return tuple(chosen)
