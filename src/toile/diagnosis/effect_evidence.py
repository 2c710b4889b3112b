"""Evidence for an effect whose size is not known beforehand.

A prior deviation says how large a coefficient may be, not how large it is. Gusts of a session have sixty
coefficients; under a prior for strong ones each is charged for a width that it does not use, and weak gusts
lose two hundred nats that way. So the deviation is unknown as well, the same for all coefficients of the
effect, and averaged over (a hierarchical prior; MacKay 1992, Bayesian interpolation).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

Array = NDArray[np.float64]

SIZES = tuple(float(size) for size in np.geomspace(0.03, 3.0, 9))
"""Prior deviations of coefficients in their own units, equally probable."""

NOTICED = tuple(float(size) for size in np.geomspace(1.5, 30.0, 9))
"""The same in units of what moves the cloth just so far that it is noticed."""

_NOTHING = 1e-9
"""Nats that a quadratic gains at its minimum where there is none."""


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
        travel: by how much the effect moves the cloth for each unit of its coefficients' root mean square
            [widths], see effect_size.travel; None where that is not known.
    """

    drop: float
    information: tuple[float, ...]
    slopes: tuple[float, ...]
    fitted_size: float
    travel: float | None = None

    @staticmethod
    def of(
        drop: float,
        coefficients: Array,
        covariance: Array,
        fitted_size: float,
        travel: float | None = None,
    ) -> EffectEvidence:
        """From a fit.

        Args:
            drop: of the misfit against the base model [nats].
            coefficients: fitted (n,).
            covariance: of them under that prior (n, n).
            fitted_size: the prior's deviation.
            travel: see EffectEvidence.
        """
        precision = np.linalg.inv(covariance)
        known = 0.5 * (precision + precision.T) - np.eye(len(coefficients)) / fitted_size**2
        values, axes = np.linalg.eigh(known)
        slopes = axes.T @ (precision @ coefficients)
        information = np.clip(values, 0.0, None)
        return EffectEvidence(
            drop, tuple(map(float, information)), tuple(map(float, slopes)), fitted_size, travel
        )

    @property
    def occam(self) -> float:
        """Penalty under the prior of the fit [nats]."""
        return float(0.5 * np.log1p(self.fitted_size**2 * np.array(self.information)).sum())

    def nats(self, scale: float = 1.0, smallest: float = 0.0) -> float:
        """Log evidence against the base model, the effect's size averaged over.

        Args:
            scale: by which all misfits are too large.
            smallest: distance by which an effect moves the cloth that is noticed [widths]: only larger sizes
                count. With 0, or without ``travel``, all do.
        """
        if not smallest or not self.travel:
            return self._averaged(SIZES, scale)
        return self._averaged([smallest / self.travel * size for size in NOTICED], scale)

    def unnoticed(self, scale: float, smallest: float) -> float:
        """The same of an effect that moves the cloth just so far that it is not noticed; at least 0."""
        if not smallest or not self.travel:
            return 0.0
        return max(self._averaged((smallest / self.travel,), scale), 0.0)

    def _averaged(self, sizes: Sequence[float], scale: float) -> float:
        """Log evidence against coefficients of zero, with equally probable prior deviations."""
        information = np.array(self.information)
        of_sizes = [
            self._gain(size, scale) - 0.5 * np.log1p(size**2 * information / scale).sum() for size in sizes
        ]
        return float(logsumexp(of_sizes) - np.log(len(sizes)))

    def _gain(self, size: float, scale: float) -> float:
        """By how much the misfit drops with a prior of this deviation, the prior's part in it [nats]."""
        information, slopes, fitted = np.array(self.information), np.array(self.slopes), self.fitted_size**-2
        coefficients = slopes / (information + fitted)
        at_fit = 0.5 * float((slopes * coefficients).sum())
        if at_fit < _NOTHING:
            return 0.0
        if size > self.fitted_size:
            # What lies farther than the fit has been is not claimed; where it is costs less.
            strength = 0.5 * float((coefficients**2).sum())
            return (self.drop + strength * fitted) / scale - strength / size**2
        # The quadratic says how it grows with the size, the fit how much it is.
        narrower = 0.5 * float(((slopes / scale) ** 2 / (information / scale + size**-2)).sum())
        return self.drop / at_fit * narrower
