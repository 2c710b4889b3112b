"""Evidence for one coefficient whose fit has ended at its bound: no friction at all, no air.

A Gaussian around the fit would count values that there are not. The misfit still falls towards the bound, so
only what lies within counts: the same quadratic under a prior that is cut off there and normalised.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp
from scipy.stats import norm

from toile.diagnosis.effect_evidence import SIZES


@dataclass(frozen=True)
class BoundedEvidence:
    """What a fit at the lower bound says about its coefficient.

    Attributes:
        drop: of the misfit against none, without the prior's part [nats].
        coefficient: the bound, below 0, in usual sizes.
        slope: of the misfit there.
        information: its curvature.
    """

    drop: float
    coefficient: float
    slope: float
    information: float

    def nats(self, scale: float = 1.0) -> float:
        """Log evidence against none, the effect's size averaged over as in EffectEvidence.

        Args:
            scale: by which all misfits are too large.
        """
        at = self.coefficient
        known = self.information / scale
        # The quadratic where the coefficient is 0: its gain, and the slope of the gain.
        offset = (self.drop + self.slope * at - 0.5 * self.information * at**2) / scale
        rise = (self.information * at - self.slope) / scale
        of_sizes = []
        for size in SIZES:
            precision = known + size**-2
            whole = 0.5 * rise**2 / precision - 0.5 * np.log(size**2 * precision)
            within = norm.logsf((at - rise / precision) * np.sqrt(precision)) - norm.logsf(at / size)
            of_sizes.append(whole + within)
        return float(offset + logsumexp(of_sizes) - np.log(len(SIZES)))
