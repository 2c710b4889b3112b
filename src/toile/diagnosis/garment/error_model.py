"""How wrong the masks of a right model are, learnt from clips that lack nothing.

Pixels and frames do not err independently, and another mesh, time step or law of the cloth looks a little
like a change of the effects themselves: a coarse cloth is stiffer. So the error of a right model is

    e = J z + n,   z ~ N(0, diag(d²)),   n ~ N(0, s² I),

with J the answers of the effects. Both d and s come from how null clips project on J: s² is the variance of
single numbers times that by which their correlation makes sums of them larger, so that the ratio of the two
is how many numbers count as one (Kennedy and O'Hagan 2001, Bayesian calibration of computer models, for a
discrepancy of the model; effective sample size).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from toile.diagnosis.garment.effects import EFFECTS

Floats = NDArray[np.float64]

# Before any clip: numbers that count as one, usual error in sizes of an effect; deviations of logarithms.
_ALIKE, _ALIKE_SPREAD = 30.0, 1.5
_USUAL, _USUAL_SPREAD = 0.3, 1.0


@dataclass(frozen=True)
class ErrorModel:
    """Error of smoothed masks of a right model.

    Attributes:
        variance: s² of one number.
        left: mean square that null clips keep when all effects have explained what they can.
        usual: d, in coefficients, by name of the effect.
        clips: number of null clips it was learnt from.
    """

    variance: float
    left: float
    usual: Mapping[str, float]
    clips: int

    @property
    def alike(self) -> float:
        """How many numbers count as one."""
        return self.variance / self.left

    @staticmethod
    def of(clips: Sequence[tuple[Floats, Floats]]) -> ErrorModel:
        """Maximum of the posterior over s and d.

        Args:
            clips: of every null clip what the model is wrong by (n,) and the answers (n, E).
        """
        explained, inverses, left = [], [], []
        for error, answers in clips:
            gram = answers.T @ answers
            coefficients = np.linalg.solve(gram, answers.T @ error)
            explained.append(coefficients)
            inverses.append(np.linalg.inv(gram))
            left.append(float(np.mean(np.square(error - answers @ coefficients))))
        mean_left = float(np.mean(left))

        def cost(x: Floats) -> float:
            """Negative log posterior of (log alike, log d)."""
            total = 0.5 * ((x[0] - np.log(_ALIKE)) / _ALIKE_SPREAD) ** 2
            total += 0.5 * float(np.square((x[1:] - np.log(_USUAL)) / _USUAL_SPREAD).sum())
            for c, inverse in zip(explained, inverses, strict=True):
                covariance = np.exp(x[0]) * mean_left * inverse + np.diag(np.exp(2 * x[1:]))
                total += 0.5 * float(c @ np.linalg.solve(covariance, c))
                total += 0.5 * float(np.linalg.slogdet(covariance)[1])
            return float(total)

        start = np.log([_ALIKE, *[_USUAL] * len(EFFECTS)])
        found = minimize(cost, start, method="L-BFGS-B", bounds=[(-5.0, 12.0)] + [(-8.0, 4.0)] * len(EFFECTS))
        usual = dict(zip(EFFECTS, map(float, np.exp(found.x[1:])), strict=True))
        return ErrorModel(float(np.exp(found.x[0])) * mean_left, mean_left, usual, len(clips))

    def weighing(self, answers: Floats) -> Weighing:
        """The inverse covariance for a clip with such answers (n, E)."""
        usual = np.array([self.usual[name] for name in EFFECTS])
        return Weighing(self.variance, answers * usual)

    def to_dict(self) -> dict[str, Any]:
        """As JSON values."""
        return {
            "variance": self.variance,
            "left": self.left,
            "usual": dict(self.usual),
            "clips": self.clips,
        }

    @staticmethod
    def from_dict(values: Mapping[str, Any]) -> ErrorModel:
        """Inverse of ``to_dict``."""
        usual = {name: float(values["usual"][name]) for name in EFFECTS}
        return ErrorModel(float(values["variance"]), float(values["left"]), usual, int(values["clips"]))


class Weighing:
    """(s² I + U Uᵀ)⁻¹ by Woodbury's identity.

    Args:
        variance: s².
        errors: U (n, E), usual errors as columns.
    """

    def __init__(self, variance: float, errors: Floats) -> None:
        self._variance, self._errors = variance, errors
        self._inner = np.linalg.inv(variance * np.eye(errors.shape[1]) + errors.T @ errors)

    def __call__(self, vector: Floats) -> Floats:
        """Of a vector (n,): (n,)."""
        found: Floats = (vector - self._errors @ (self._inner @ (self._errors.T @ vector))) / self._variance
        return found

    def cost(self, vector: Floats) -> float:
        """Half the weighed square [nats]."""
        return 0.5 * float(vector @ self(vector))
