"""A diagnosis of one clip: verdict, estimates, and how far the error of frames that nobody fitted falls."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from toile.diagnosis.garment.effects import EFFECTS
from toile.diagnosis.garment.error_model import ErrorModel
from toile.diagnosis.garment.fit import ClipFits, ClipFitting
from toile.diagnosis.garment.verdict import DecisionWeights, Verdict

SHIPPED = Path(__file__).parent / "calibration.json"
"""The package's own, made by benchmarks/capture_diagnosis.py."""


@dataclass(frozen=True)
class MadeWith:
    """What clips are like that a calibration holds for, or that one clip is like.

    Attributes:
        width: of the images [px].
        frames: from rest.
        fps: frames per second.
        vertices: of the model's garment.
        garment: its kind.
        substeps: of the model, per frame.
    """

    width: int
    frames: int
    fps: float
    vertices: int
    garment: str
    substeps: int

    def differences(self, other: MadeWith) -> tuple[str, ...]:
        """What is not alike, in words."""
        mine, others = asdict(self), asdict(other)
        return tuple(f"{k}: {mine[k]} instead of {others[k]}" for k in mine if mine[k] != others[k])


@dataclass(frozen=True)
class Calibration:
    """What generated clips say of errors and of evidence.

    Attributes:
        errors: by the number of cameras.
        weights: see DecisionWeights.
        made_with: what these clips are like.
        source: where they come from.
    """

    errors: Mapping[int, ErrorModel]
    weights: DecisionWeights
    made_with: MadeWith
    source: str

    def to_json(self) -> str:
        """The text of a file."""
        values = {
            "source": self.source,
            "made_with": asdict(self.made_with),
            "threshold": self.weights.threshold,
            "temperature": self.weights.temperature,
            "errors": {str(cameras): model.to_dict() for cameras, model in self.errors.items()},
        }
        return json.dumps(values, indent=1) + "\n"

    @staticmethod
    def load(path: Path = SHIPPED) -> Calibration:
        """From a file that ``to_json`` made."""
        values = json.loads(path.read_text(encoding="utf-8"))
        return Calibration(
            {int(cameras): ErrorModel.from_dict(model) for cameras, model in values["errors"].items()},
            DecisionWeights(float(values["threshold"]), float(values["temperature"])),
            MadeWith(**values["made_with"]),
            str(values["source"]),
        )


@dataclass(frozen=True)
class Shrinkage:
    """Error of the frames that nobody fitted: root mean square of smoothed masks.

    Attributes:
        effect: the one with most evidence.
        without: error of the model as it is.
        fitted: with the effect as fitted.
        wrong_sign: placebo, with as much of it the other way round, within its bounds.
        best_other: placebo, with the best other effect as fitted.
    """

    effect: str
    without: float
    fitted: float
    wrong_sign: float
    best_other: float

    @property
    def share(self) -> float:
        """Share of the error that the effect takes away."""
        return _share(self.fitted, self.without)

    @property
    def placebo(self) -> float:
        """Largest share that a placebo takes away."""
        return max(_share(self.wrong_sign, self.without), _share(self.best_other, self.without))


@dataclass(frozen=True)
class GarmentDiagnosis:
    """What is the matter with the model of a clip.

    Attributes:
        fits: what the clip says about all effects.
        verdict: the answer.
        shrinkage: of the effect with most evidence.
    """

    fits: ClipFits
    verdict: Verdict
    shrinkage: Shrinkage

    def to_dict(self) -> dict[str, Any]:
        """As JSON values, numbers in the units of the effects."""
        estimates = {}
        for name, fit in self.fits.fits.items():
            effect = EFFECTS[name]
            low, high = map(effect.in_units, self.fits.interval(name))
            estimates[name] = {
                "change": effect.in_units(fit.coefficient),
                "low": low,
                "high": high,
                "unit": effect.unit,
                "stage": effect.stage.value,
                "evidence_nats": self.fits.nats[name],
                "roll_outs": fit.simulated,
            }
        s = self.shrinkage
        return {
            "answer": self.verdict.answer,
            "candidates": list(self.verdict.candidates),
            "probabilities": dict(self.verdict.probabilities),
            "effects": estimates,
            "shrink": {
                "effect": s.effect,
                "share": s.share,
                "placebo": s.placebo,
                "without": s.without,
                "fitted": s.fitted,
                "wrong_sign": s.wrong_sign,
                "best_other": s.best_other,
            },
            "excess": self.fits.excess,
        }


def diagnose(fitting: ClipFitting, weights: DecisionWeights) -> GarmentDiagnosis:
    """Fit all effects to a clip and decide.

    Args:
        fitting: of the clip.
        weights: learnt on generated clips.
    """
    fits = fitting.fit()
    return GarmentDiagnosis(
        fits, Verdict.of(weights.probabilities(fits.nats)), measured_shrinkage(fitting, fits)
    )


def measured_shrinkage(fitting: ClipFitting, fits: ClipFits) -> Shrinkage:
    """Of the effect with most evidence; its placebo of the wrong sign is simulated."""
    first, second = sorted(fits.nats, key=lambda name: -fits.nats[name])[:2]
    best = fits.fits[first]
    masks = best.masks if best.simulated else fitting.masks(first, best.coefficient)
    against = float(np.clip(-best.coefficient, fitting.least(first), None))
    return Shrinkage(
        first,
        fitting.held_out_error(fitting.base),
        fitting.held_out_error(masks),
        fitting.held_out_error(fitting.masks(first, against)),
        fitting.held_out_error(fits.fits[second].masks),
    )


def _share(error: float, without: float) -> float:
    return 1 - error / without if without > 0 else 0.0
