"""Evidence for an effect whose size is not known beforehand.

A prior deviation says how large a coefficient may be, not how large it is. Gusts of a session have sixty
coefficients; under a prior for strong ones each is charged for a width that it does not use, and weak gusts
lose two hundred nats that way. So the deviation is unknown as well, the same for all coefficients of the
effect, and averaged over (a hierarchical prior; MacKay 1992, Bayesian interpolation).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

Array = NDArray[np.float64]

SIZES = tuple(float(size) for size in np.geomspace(0.03, 3.0, 9))
"""Prior deviations of coefficients in their own units, equally probable."""


@dataclass(frozen=True)
class EffectEvidence:
    """What a fit says about the coefficients of an effect.

    Around the fit the misfit is a quadratic of the n coefficients, all other unknowns following; this is it
    along its axes.

    Attributes:
        drop: of the misfit against the base model, the prior's part in it [nats].
        information: eigenvalues of what the clips know about the coefficients (n,).
        slopes: of the misfit where all coefficients are zero, along the axes (n,).
        fitted_size: prior deviation under which it was fitted.
    """

    drop: float
    information: tuple[float, ...]
    slopes: tuple[float, ...]
    fitted_size: float

    @staticmethod
    def of(drop: float, coefficients: Array, covariance: Array, fitted_size: float) -> EffectEvidence:
        """From a fit.

        Args:
            drop: of the misfit against the base model [nats].
            coefficients: fitted (n,).
            covariance: of them under that prior (n, n).
            fitted_size: the prior's deviation.
        """
        precision = np.linalg.inv(covariance)
        known = 0.5 * (precision + precision.T) - np.eye(len(coefficients)) / fitted_size**2
        values, axes = np.linalg.eigh(known)
        slopes = axes.T @ (precision @ coefficients)
        information = np.clip(values, 0.0, None)
        return EffectEvidence(drop, tuple(map(float, information)), tuple(map(float, slopes)), fitted_size)

    @property
    def occam(self) -> float:
        """Penalty under the prior of the fit [nats]."""
        return float(0.5 * np.log1p(self.fitted_size**2 * np.array(self.information)).sum())

    def nats(self, scale: float = 1.0) -> float:
        """Log evidence against the base model, the effect's size averaged over.

        Args:
            scale: by which all misfits are too large.
        """
        information, slopes = np.array(self.information), np.array(self.slopes)
        inside = 0.5 * (slopes**2 / (information + self.fitted_size**-2)).sum()
        information, slopes = information / scale, slopes / scale
        of_sizes = [
            0.5 * (slopes**2 / (information + size**-2)).sum() - 0.5 * np.log1p(size**2 * information).sum()
            for size in SIZES
        ]
        # What the quadratic does not say, the fit does.
        return float((self.drop - inside) / scale + logsumexp(of_sizes) - np.log(len(SIZES)))
