"""From evidence to probabilities, calibrated on scenes made for it, and a confidence set."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from toile.diagnosis.made_with import MadeWith
from toile.diagnosis.record import CalibrationUse
from toile.errors import InputError
from toile.json_file import place
from toile.limits import Finite, NonNegative, Positive

NONE = "none"
UNKNOWN = "unknown"
SHIPPED = Path(__file__).parent / "calibration.json"
"""The package's own calibration."""


@dataclass(frozen=True)
class Weights:
    """What in-sample fit and prediction count for, with effects that move the cloth and what is unknown.

    Attributes:
        in_sample: share of the log Bayes factor from fitted windows that counts.
        most: log evidence beyond which more says nothing: it comes from an error that the effect takes up.
        predictive: log evidence for each logarithm by which windows are predicted better.
        farthest: logarithm beyond which better says nothing.
        smallest: size of an effect, over the cloth's width, from which on what speaks for it counts in full,
            and error of the time step up to which it does; see effect_size and time_step_error.
    """

    in_sample: NonNegative = 0.5
    most: NonNegative = 60.0
    predictive: NonNegative = 20.0
    farthest: NonNegative = 0.5
    smallest: Positive = 0.005

    def combined(self, evidence: float, gain: float, size: float = np.inf, numerics: float = 0.0) -> float:
        """Log evidence that counts.

        Args:
            evidence: from fitted windows.
            gain: logarithm by which windows are predicted better.
            size: how far the effect moves the cloth, over the cloth's width.
            numerics: how far half the time step does.
        """
        predicted = float(np.clip(gain, -self.farthest, self.farthest))
        value = self.in_sample * min(evidence, self.most) + self.predictive * predicted
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
        made_with: settings of the diagnosis that it belongs to; None if nothing says so: then it belongs to
            none.
    """

    usual: Mapping[str, float]
    spread: Mapping[str, float]
    temperature: float
    threshold: float
    unknown: float
    source: str
    made_with: MadeWith | None = None

    @staticmethod
    def load(path: Path | None = None) -> Calibration:
        """The calibration in a file; None for the one that comes with the package.

        Raises:
            InputError: there is no such file, or it is no calibration.
        """
        try:
            text = (SHIPPED if path is None else path).read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise _wrong(path, f"{type(error).__name__}: {error}") from error
        return Calibration.from_json(text, path)

    @staticmethod
    def from_json(text: str, path: Path | None = None) -> Calibration:
        """The calibration in a text.

        Args:
            text: see ``to_json``.
            path: where it comes from, for messages.

        Raises:
            InputError: it is no calibration.
        """
        try:
            found = _File.model_validate_json(text)
        except ValidationError as error:
            first = error.errors()[0]
            raise _wrong(path, f"{place(first['loc']) or 'the file'}: {first['msg']}") from error
        made_with = None if found.settings is None else MadeWith(found.settings)
        if made_with is not None and found.settings_digest != made_with.digest:
            raise _wrong(path, f"settings_digest {found.settings_digest} of other settings than those listed")
        made_with = made_with and made_with.with_present_names()
        return Calibration(
            found.usual,
            found.spread,
            found.temperature,
            found.threshold,
            found.unknown,
            found.source,
            made_with,
        )

    def to_json(self) -> str:
        """The text of a file; what is usual is rounded to a thousandth."""
        values: dict[str, Any] = {
            "usual": {name: round(value, 3) for name, value in self.usual.items()},
            "spread": {name: round(value, 3) for name, value in self.spread.items()},
            "temperature": self.temperature,
            "threshold": self.threshold,
            "unknown": self.unknown,
            "source": self.source,
        }
        if self.made_with is None:
            return json.dumps(values, indent=1) + "\n"
        values["settings_digest"] = self.made_with.digest
        # One line each, lists too, to be read by people.
        settings = (
            f"  {json.dumps(name)}: {json.dumps(value)}" for name, value in self.made_with.settings.items()
        )
        text = json.dumps(values, indent=1).removesuffix("\n}")
        return f'{text},\n "settings": {{\n' + ",\n".join(settings) + "\n }\n}\n"

    def use(self, diagnosis: MadeWith | None, file: Path | None = None) -> CalibrationUse:
        """What a diagnosis with these settings must say of its probabilities.

        Args:
            diagnosis: its settings; None if nothing is known of them.
            file: that the calibration comes from; None for the package's own.
        """
        differences: tuple[str, ...]
        if diagnosis is None:
            differences = ("the settings of the diagnosis are not known",)
        elif self.made_with is None:
            differences = ("the calibration does not say which settings it belongs to",)
        else:
            differences = diagnosis.differences(self.made_with)
        return CalibrationUse(
            not differences,
            "" if file is None else str(file),
            "" if diagnosis is None else diagnosis.digest,
            "" if self.made_with is None else self.made_with.digest,
            differences,
        )

    def score(self, name: str, log_evidence: float) -> float:
        """Log evidence in deviations above what is usual without the effect.

        What is usually against an effect does not speak for it where it is missing: a clip that says nothing
        scores 0.
        """
        usual = max(self.usual.get(name, 0.0), 0.0)
        return (log_evidence - usual) / max(self.spread.get(name, 1.0), 1.0)


class _File(BaseModel):
    """Keys of a calibration's file."""

    model_config = ConfigDict(extra="forbid", strict=True)

    usual: dict[str, Finite]
    spread: dict[str, Positive]
    temperature: Positive
    threshold: Finite
    unknown: Finite
    source: str
    settings_digest: str | None = None
    settings: dict[str, Any] | None = None


def _wrong(path: Path | None, got: str) -> InputError:
    return InputError(
        "No calibration can be read",
        where=f"diagnosis.calibration={SHIPPED if path is None else path}",
        expected="a file that toile calibrate has written; null for the package's own",
        got=got,
    )


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
