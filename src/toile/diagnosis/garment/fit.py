"""Fits of one clip: what it says about every effect alone.

Every hypothesis is none, or one effect with one coefficient. Its cost is half the weighed square of observed
minus simulated masks, and of the coefficient under a wide prior. All effects are judged in the linearised
model first; those with most evidence are simulated at the coefficient that it asks for, again with the slope
between the last two roll-outs, and a step that does not lower the cost is halved (damped Gauss-Newton;
the slope is the secant of Broyden 1965, which for one coefficient needs no derivative).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from toile.diagnosis.effect_evidence import EffectEvidence
from toile.diagnosis.garment.bounded_evidence import BoundedEvidence
from toile.diagnosis.garment.effects import EFFECTS
from toile.diagnosis.garment.error_model import ErrorModel
from toile.diagnosis.garment.masks import SmoothedAreas
from toile.diagnosis.garment.responses import Responses
from toile.diagnosis.garment.rollout import Seen
from toile.diagnosis.garment.scene import Scene
from toile.limits import Count, NonNegative, Positive

Floats = NDArray[np.float64]


class Looking(Protocol):
    """What a fit needs of roll-outs."""

    def __call__(self, scene: Scene, cameras: int | None = None) -> Seen:
        """Roll out and look; see RollOuts."""


@dataclass(frozen=True)
class FitSettings:
    """Settings of the fits.

    Attributes:
        simulated: how many effects are simulated at most: the two with most evidence, as long as one of them
            has not been.
        worth: evidence in that model below which none is [nats].
        roll_outs: at most, for one effect.
        enough: change of the coefficient, in its deviation, below which it has arrived.
        size: prior deviation during the fit, in usual sizes; the evidence averages over sizes.
        farthest: coefficient within which steps stay, in usual sizes.
    """

    simulated: Count = 3
    worth: NonNegative = 1.0
    roll_outs: Count = 3
    enough: Positive = 0.3
    size: Positive = 3.0
    farthest: Positive = 8.0


@dataclass(frozen=True)
class HypothesisFit:
    """One effect, fitted.

    Attributes:
        effect: its name.
        coefficient: in usual sizes.
        deviation: of it under the prior of the fit.
        evidence: see EffectEvidence; BoundedEvidence where the fit has ended at a bound of the scene.
        left: mean square of what is left, of one number.
        simulated: roll-outs that were spent on it; 0 where the linearised model alone speaks.
        masks: smoothed masks of all frames (C, 2, F, h, w).
    """

    effect: str
    coefficient: float
    deviation: float
    evidence: EffectEvidence | BoundedEvidence
    left: float
    simulated: int
    masks: Floats


@dataclass(frozen=True)
class ClipFits:
    """What a clip says about all effects.

    Attributes:
        fits: by name.
        nats: log evidence against none, sizes averaged over, by name.
        excess: by how much more than on null clips even the best model leaves; costs are divided by it.
    """

    fits: Mapping[str, HypothesisFit]
    nats: Mapping[str, float]
    excess: float

    @property
    def best(self) -> HypothesisFit:
        """The effect with most evidence."""
        return self.fits[max(self.nats, key=lambda name: self.nats[name])]

    def interval(self, name: str, deviations: float = 1.645) -> tuple[float, float]:
        """Of a coefficient; 90 % of a Gaussian unless told otherwise."""
        fit = self.fits[name]
        half = deviations * fit.deviation * float(np.sqrt(self.excess))
        return fit.coefficient - half, fit.coefficient + half


class ClipFitting:
    """Fits every effect to one clip.

    Args:
        look: rolls the model out.
        scene: of the model.
        responses: of the model to all effects.
        observed: smoothed masks (C, 2, F, h, w); C may be less than the cameras of ``look``.
        errors: how wrong a right model is.
        form: in which masks are compared.
        settings: see FitSettings.

    Attributes:
        frames: those that are fitted, the first two thirds.
        held_out: those that are not.
    """

    def __init__(
        self,
        look: Looking,
        scene: Scene,
        responses: Responses,
        observed: Floats,
        errors: ErrorModel,
        form: SmoothedAreas | None = None,
        settings: FitSettings | None = None,
    ) -> None:
        self._look, self._scene, self._responses = look, scene, responses
        self._form, self._settings = form or SmoothedAreas(), settings or FitSettings()
        self._errors = errors
        self.observed = observed
        self.cameras = len(observed)
        self.frames, self.held_out = split(observed.shape[2])
        self._answers = responses.matrix(self.cameras, self.frames)
        self._weigh = errors.weighing(self._answers)
        self._none = self._weigh.cost(self._missing(self.base))

    @property
    def base(self) -> Floats:
        """Smoothed masks of the model without any effect (C, 2, F, h, w)."""
        return self._responses.base[: self.cameras]

    def fit(self) -> ClipFits:
        """All effects."""
        fits = {name: self._linearised(name) for name in EFFECTS}
        for _ in range(self._settings.simulated):
            # What is worth a roll-out is seen without the excess: a model far off is what it may mend.
            order = sorted(fits, key=lambda name: -fits[name].evidence.nats())
            open_ones = [name for name in order[:2] if not fits[name].simulated]
            if not open_ones or fits[open_ones[0]].evidence.nats() < self._settings.worth:
                break
            fits[open_ones[0]] = self._simulated(open_ones[0])
        excess = self._excess(fits.values())
        return ClipFits(fits, {name: fit.evidence.nats(excess) for name, fit in fits.items()}, excess)

    def masks(self, name: str, coefficient: float) -> Floats:
        """Smoothed masks of the model with so much of an effect (C, 2, F, h, w)."""
        return self._form(self._look(EFFECTS[name].changed(self._scene, coefficient), self.cameras).masks)

    def held_out_error(self, masks: Floats) -> float:
        """Root mean square over the frames that nobody fitted, of smoothed masks."""
        missing = (self.observed - masks)[:, :, self.held_out]
        return float(np.sqrt(np.mean(np.square(missing))))

    def least(self, name: str) -> float:
        """Smallest coefficient of an effect."""
        return max(EFFECTS[name].least(self._scene), -self._settings.farthest)

    def _missing(self, masks: Floats) -> Floats:
        """Observed minus simulated, of the frames that are fitted (n,)."""
        return (self.observed - masks)[:, :, self.frames].ravel()

    def _excess(self, fits: Iterable[HypothesisFit]) -> float:
        joint = self._missing(self.base)
        joint = joint - self._answers @ np.linalg.lstsq(self._answers, joint, rcond=None)[0]
        best = min(float(np.mean(np.square(joint))), *(fit.left for fit in fits))
        return max(1.0, best / self._errors.left)

    def _within(self, name: str, coefficient: float) -> float:
        return float(np.clip(coefficient, self.least(name), self._settings.farthest))

    def _cost(self, masks: Floats, coefficient: float) -> float:
        return self._weigh.cost(self._missing(masks)) + 0.5 * (coefficient / self._settings.size) ** 2

    def _linearised(self, name: str) -> HypothesisFit:
        slope = self._responses.answers[name][: self.cameras]
        known = self._information(slope)
        best = float(self._slice(slope) @ self._weigh(self._missing(self.base))) / known
        coefficient = self._within(name, best)
        return self._fitted(name, coefficient, self.base + coefficient * slope, slope, 0)

    def _simulated(self, name: str) -> HypothesisFit:
        """Step by step from where there is none of it."""
        s = self._settings
        at, masks, cost = 0.0, self.base, self._none
        slope = self._responses.answers[name][: self.cameras]
        spent = 0
        while spent < s.roll_outs:
            known = self._information(slope)
            pull = float(self._slice(slope) @ self._weigh(self._missing(masks))) - at / s.size**2
            target = self._within(name, at + pull / known)
            if abs(target - at) * np.sqrt(known) < s.enough:
                break
            step = target - at
            found = None
            while spent < s.roll_outs and found is None:
                trial = self.masks(name, at + step)
                spent += 1
                if self._cost(trial, at + step) < cost:
                    found = trial
                else:
                    step /= 2
            if found is None:
                break
            slope = (found - masks) / step
            at, masks = at + step, found
            cost = self._cost(masks, at)
        return self._fitted(name, at, masks, slope, spent)

    def _fitted(
        self, name: str, coefficient: float, masks: Floats, slope: Floats, spent: int
    ) -> HypothesisFit:
        variance = 1 / self._information(slope)
        drop = self._none - self._cost(masks, coefficient)
        evidence: EffectEvidence | BoundedEvidence = EffectEvidence.of(
            drop, np.array([coefficient]), np.array([[variance]]), self._settings.size
        )
        lowest = EFFECTS[name].least(self._scene)
        pull = float(self._slice(slope) @ self._weigh(self._missing(masks)))
        if coefficient < lowest + 1e-9 and pull < coefficient / self._settings.size**2:
            known = 1 / variance - self._settings.size**-2
            gain = self._none - self._weigh.cost(self._missing(masks))
            evidence = BoundedEvidence(gain, coefficient, -pull, known)
        left = float(np.mean(np.square(self._missing(masks))))
        return HypothesisFit(name, coefficient, float(np.sqrt(variance)), evidence, left, spent, masks)

    def _information(self, slope: Floats) -> float:
        along = self._slice(slope)
        return float(along @ self._weigh(along)) + self._settings.size**-2

    def _slice(self, slope: Floats) -> Floats:
        return slope[:, :, self.frames].ravel()


def split(frames: int) -> tuple[slice, slice]:
    """The first two thirds of the frames, which are fitted, and the others."""
    fitted = (2 * frames) // 3
    return slice(0, fitted), slice(fitted, frames)
