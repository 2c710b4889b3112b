"""How well each hypothesis explains what the base model leaves: Gaussian evidence around the base fit.

Unknown are the local quantities of every window, among them a smooth force field of unknown size (the
discrepancy), the base's stiffness and wind, and a hypothesis' own coefficients. All are Gaussian a priori and
enter linearly around the base fit, so all but the size of the discrepancy is integrated out, and that is
scanned. A hypothesis gains by making the discrepancy small, not by fitting better.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.linalg import cho_solve

from toile.diagnosis.continuity import Discrepancy, Joined, Reduced, WindowSystem
from toile.diagnosis.positive import positive_factor
from toile.limits import Count, NonNegative, Positive, Unit

Array = NDArray[np.float64]

Sizes = Annotated[tuple[Positive, ...], Field(min_length=1), Unit("m/s²")]
"""Deviations of a force per mass."""


@dataclass(frozen=True)
class Posterior:
    """One hypothesis.

    Attributes:
        log_evidence: integrated over the hypothesis' coefficients, at its best discrepancy.
        discrepancy: that one.
        mean, covariance: of the effect's coefficients, in units of their prior deviations, (n,), (n, n).
        free: which of the shared unknowns those are.
        prior_inflation: deviation of the coefficients a priori, in the same units.
    """

    log_evidence: float
    discrepancy: Discrepancy
    mean: Array
    covariance: Array
    free: tuple[int, ...]
    prior_inflation: float


@dataclass(frozen=True)
class EvidenceSettings:
    """What is tried for a hypothesis, and what it is penalised.

    Attributes:
        internal: deviations of an internal force mode that are tried [m/s²].
        external: of an external one.
        prior_inflation: factor on the prior deviations of an effect's coefficients: those say how large one
            usually is, not how large it can be.
        many: coefficients of an effect from which on their common scale is found.
        scales: shares of the usual one that are tried for it, and penalised.
        forbidden: log evidence taken from an effect all of whose signs are impossible.
    """

    internal: Sizes = (0.0125, 0.025, 0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2)
    external: Sizes = (0.003125, 0.00625, 0.0125, 0.025, 0.05, 0.1, 0.2, 0.4, 0.8, 1.6)
    prior_inflation: Positive = 1.5
    many: Count = 4
    scales: Annotated[tuple[Positive, ...], Field(min_length=1)] = (0.05, 0.15, 0.4, 1.0)
    forbidden: NonNegative = 20.0

    def tried(self, size: Discrepancy) -> Discrepancy:
        """The largest discrepancy that is tried and not above ``size``, or the smallest."""
        return Discrepancy(
            max((d for d in self.internal if d <= size.internal), default=min(self.internal)),
            max((d for d in self.external if d <= size.external), default=min(self.external)),
        )


DEFAULT = EvidenceSettings()
ANY = Discrepancy(np.inf, np.inf)


class Evidence:
    """Evidence of hypotheses on one clip.

    Args:
        systems: of all windows.
        values: base values of the fit (n_base,).
        deviations: their prior deviations.
        settings: see EvidenceSettings.
        coefficients: of the effects around which the systems are, in prior deviations; None for zeros.
        like: evidence whose determinants of the local unknowns stand for those here; None for their own.
            Around two motions they differ by where a fold is about to snap through, which is no knowledge.
    """

    def __init__(
        self,
        systems: Sequence[WindowSystem],
        values: Array,
        deviations: Array,
        settings: EvidenceSettings = DEFAULT,
        coefficients: Array | None = None,
        like: Evidence | None = None,
    ) -> None:
        self.systems = list(systems)
        self.n_base = len(values)
        self.values = values
        self.deviations = deviations
        self.settings = settings
        self.prior_inflation = settings.prior_inflation
        self.n_shared = len(systems[0].gradient) - len(systems[0].standardised)
        self.coefficients = np.zeros(self.n_shared - self.n_base) if coefficients is None else coefficients
        self._like = like
        self._reduced: dict[Discrepancy, Reduced] = {}

    def reduced(self, size: Discrepancy) -> Reduced:
        """The clip without local unknowns at a size of the discrepancy, kept."""
        if size not in self._reduced:
            found = Joined(self.systems, size).reduced
            if self._like is not None:
                found = replace(found, determinant=self._like.reduced(size).determinant)
            self._reduced[size] = found
        return self._reduced[size]

    def posterior(
        self, free: Sequence[int], largest: Discrepancy = ANY, prior_inflation: float | None = None
    ) -> Posterior:
        """The hypothesis that frees these coefficients, at its best discrepancy up to ``largest``."""
        limit = self.settings.tried(largest)
        internal = sorted(d for d in self.settings.internal if d <= limit.internal)
        external = sorted(d for d in self.settings.external if d <= limit.external)
        found: dict[tuple[int, int], Posterior] = {}

        def at(place: tuple[int, int]) -> float:
            if place not in found:
                size = Discrepancy(internal[place[0]], external[place[1]])
                found[place] = self._at(free, size, prior_inflation)
            return found[place].log_evidence

        # Uphill from the best of three places: every size that is looked at costs an elimination of all
        # windows. Where all is large, where inner forces are smaller, and where all are.
        a, b = len(internal) - 1, len(external) - 1
        here = max(((a, b), (a // 2, b), (a // 2, b // 2)), key=at)
        while True:
            best = max(product(_near(here[0], a), _near(here[1], b)), key=at)
            if at(best) <= at(here):
                return found[here]
            here = best

    def signed(self, places: Sequence[int], lowest: Array, largest: Discrepancy = ANY) -> Posterior:
        """The best hypothesis among subsets of coefficients that obey their bounds.

        Args:
            places: of one effect's coefficients among the shared unknowns.
            lowest: 0 where a coefficient cannot be negative, -inf elsewhere.
            largest: discrepancy.
        """
        bounded = [i for i in range(len(places)) if lowest[i] == 0]
        free = [i for i in range(len(places)) if lowest[i] != 0]
        best: Posterior | None = None
        subsets = [c for r in range(len(bounded) + 1) for c in combinations(bounded, r)]
        for subset in subsets:
            chosen = [places[i] for i in sorted((*subset, *free))]
            if not chosen:
                continue
            found = self.scaled(chosen, largest)
            low = np.array([lowest[list(places).index(c)] for c in found.free])
            if (found.mean < low).any():
                continue
            if best is None or found.log_evidence > best.log_evidence:
                best = found
        if best is None:
            none = self.posterior((), largest)
            return replace(none, log_evidence=none.log_evidence - self.settings.forbidden)
        return replace(best, log_evidence=best.log_evidence - sign_penalty(lowest))

    def scaled(self, free: Sequence[int], largest: Discrepancy) -> Posterior:
        """The posterior; many coefficients of an effect are at their best common scale, which is penalised.

        Each of many is penalised for its prior's width, so a width that is too large by far hides a field or
        a gust that is there (automatic relevance determination, MacKay 1992).
        """
        if len(free) < self.settings.many:
            return self.posterior(free, largest)
        scales = self.settings.scales
        found = [self.posterior(free, largest, share * self.prior_inflation) for share in scales]
        best = max(found, key=lambda posterior: posterior.log_evidence)
        return replace(best, log_evidence=best.log_evidence - float(np.log(len(scales))))

    def loss_drop(self, free: Sequence[int], size: Discrepancy) -> float:
        """By how much the training loss falls with these coefficients free, without any penalty for them."""
        size = self.settings.tried(size)
        fitted = self._at(free, size, penalised=False).log_evidence
        return fitted - self._at((), size, penalised=False).log_evidence

    def fisher(self, size: Discrepancy) -> Array:
        """Information on all effects' coefficients; base, local unknowns and discrepancy integrated out."""
        return self.information(range(self.n_base, self.n_shared), size)[0]

    def information(
        self,
        free: Sequence[int],
        size: Discrepancy,
        usual: Sequence[int] = (),
        inflation: float | Sequence[float] = 1.0,
    ) -> tuple[Array, Array]:
        """Information on some effects' coefficients, and the slope of the likelihood by them.

        Base, local unknowns and discrepancy are integrated out; no other effect acts.

        Args:
            free: places of the coefficients among the shared unknowns.
            size: of the discrepancy.
            usual: places of coefficients that belong to the base.
            inflation: prior deviation of those, of all or of each.
        """
        reduced = self.reduced(size)
        base = [*range(self.n_base), *usual]
        of_usual = np.broadcast_to(np.asarray(inflation, np.float64), len(usual))
        precision = np.concatenate((self.deviations**-2, of_usual**-2))
        now = np.concatenate((self.values, self.coefficients[[place - self.n_base for place in usual]]))
        A = reduced.matrix[np.ix_(base, base)] + np.diag(precision)
        C = reduced.matrix[base][:, free]
        solved = np.linalg.solve(A, C)
        slope = reduced.right[free] - solved.T @ (reduced.right[base] - now * precision)
        return reduced.matrix[np.ix_(free, free)] - C.T @ solved, slope

    def towards(
        self,
        free: Sequence[int],
        size: Discrepancy,
        damping: float,
        longest: Array,
        frozen: NDArray[np.bool_] | None = None,
        prior_inflation: float | None = None,
    ) -> tuple[Array, Array, list[Array]]:
        """To where the hypothesis that frees these coefficients has its mean, or a part of the way.

        Args:
            free: see posterior.
            size: of the discrepancy.
            damping: 0 for all the way; what a step costs beside, in prior precisions: enough of it lowers
                the cost wherever the cost can be lowered.
            longest: change of the base values at most (n_base,).
            frozen: windows whose own unknowns stay as they are (n_windows,).
            prior_inflation: see posterior.

        Returns:
            Base values, the effect's coefficients, and changes of every window's local unknowns.
        """
        each = np.full(len(self.systems), damping)
        if frozen is not None:
            each[frozen] = _FROZEN
        joined, b = Joined(self.systems, size, each), self.n_base
        index = np.array([*range(b), *free], int)
        prior_inflation = self.prior_inflation if prior_inflation is None else prior_inflation
        scale = np.concatenate((self.deviations, np.full(len(free), prior_inflation)))
        now = np.concatenate((self.values, self.coefficients[[c - b for c in free]]))
        H = joined.reduced.matrix[np.ix_(index, index)] + np.diag((1 + damping) / scale**2)
        step = np.linalg.solve(0.5 * (H + H.T), joined.reduced.right[index] - now / scale**2)
        step *= min(1.0, float((longest / np.maximum(np.abs(step[:b]), 1e-9)).min()))
        shared = np.zeros(self.n_shared)
        shared[index] = step
        return now[:b] + step[:b], now[b:] + step[b:], joined.locals(shared)

    def _at(
        self,
        free: Sequence[int],
        size: Discrepancy,
        prior_inflation: float | None = None,
        *,
        penalised: bool = True,
    ) -> Posterior:
        reduced = self.reduced(size)
        index = np.array([*range(self.n_base), *free], int)
        prior_inflation = self.prior_inflation if prior_inflation is None else prior_inflation
        scale = np.concatenate((self.deviations, np.full(len(free), prior_inflation)))
        coefficients = self.coefficients[[c - self.n_base for c in free]]
        mean = np.concatenate((self.values / self.deviations, coefficients / prior_inflation))
        H = np.eye(len(index)) + scale[:, None] * reduced.matrix[np.ix_(index, index)] * scale
        factor = positive_factor(H)
        right = scale * reduced.right[index] - mean
        standardised = cho_solve(factor, right)
        value = reduced.constant - reduced.determinant + 0.5 * right @ standardised - 0.5 * mean @ mean
        if penalised:
            value -= np.log(np.diag(factor[0])).sum()
        covariance = scale[:, None] * cho_solve(factor, np.diag(scale))
        b = self.n_base
        found = coefficients + (scale * standardised)[b:]
        return Posterior(float(value), size, found, covariance[b:, b:], tuple(free), prior_inflation)


def sign_penalty(lowest: Array) -> float:
    """Penalty of an effect for the choice of coefficients that are not at their bounds, see Evidence.signed.

    Args:
        lowest: 0 where a coefficient cannot be negative, -inf elsewhere.
    """
    n = int((lowest == 0).sum())
    return float(np.log(2**n - (n == len(lowest))))


def _near(place: int, last: int) -> range:
    """Places next to one from 0 to ``last``, and itself."""
    return range(max(place - 1, 0), min(place + 1, last) + 1)


# Damping that holds a window back: stands for infinity.
_FROZEN = 1e6
