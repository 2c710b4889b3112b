"""What every candidate has going for it, from whichever trace it leaves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toile.diagnosis.base_fit import fitted_discrepancy
from toile.diagnosis.continuity import Discrepancy
from toile.diagnosis.evidence import sign_penalty
from toile.diagnosis.mechanics import Mechanics
from toile.diagnosis.record import Estimate
from toile.effects.base import Amount, CameraEffect, Effect, Surroundings

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Finding:
    """What one candidate has going for it.

    Attributes:
        log_evidence: against the base model.
        mean, deviation: of its coefficients in their own units, by name.
        vertex: of the pinned ones, that a slip is of, from 0.
        covariance: of the coefficients in their own units (n, n); None where only deviations are known.
    """

    log_evidence: float
    mean: dict[str, float]
    deviation: dict[str, float]
    vertex: int = 0
    covariance: Array | None = field(default=None, compare=False, repr=False)


def finding(effect: Effect, log_evidence: float, mean: Array, covariance: Array) -> Finding:
    """A finding in the effect's own units from coefficients in prior deviations, (n,) and (n, n)."""
    scales = effect.scales.numpy()
    deviation = np.sqrt(np.maximum(np.diag(covariance), 0)) * scales
    names = [parameter.name for parameter in effect.parameters]
    return Finding(
        float(log_evidence),
        dict(zip(names, (mean * scales).tolist(), strict=True)),
        dict(zip(names, deviation.tolist(), strict=True)),
        covariance=scales[:, None] * covariance * scales,
    )


@dataclass(frozen=True)
class Screening:
    """What the motion says to first order around the base fit.

    Attributes:
        findings: of effects that move the cloth.
        free: which coefficients of each are not at their bounds.
        penalties: log evidence that each has been penalised for that choice.
    """

    findings: dict[str, Finding]
    free: dict[str, tuple[int, ...]]
    penalties: dict[str, float]


def mechanical_findings(mechanics: Mechanics, usual: Discrepancy) -> Screening:
    """Evidence of every effect that moves the cloth.

    Effects have to do with the usual discrepancy; what needs more is outside the catalogue. Wrong cameras are
    left to the outline of frame 0, as a motion that does not fit passes for one easily.

    Args:
        mechanics: see Mechanics.
        usual: discrepancy of a right model.
    """
    evidence = mechanics.evidence
    base = evidence.posterior((), usual)
    findings: dict[str, Finding] = {}
    free: dict[str, tuple[int, ...]] = {}
    penalties: dict[str, float] = {}
    for name, (a, b) in mechanics.coefficients.items():
        effect = mechanics.effects[name]
        if isinstance(effect, CameraEffect):
            continue
        low = np.array([0.0 if p.low == 0 else -np.inf for p in effect.parameters])
        places = list(range(evidence.n_base + a, evidence.n_base + b))
        best = evidence.signed(places, low, usual)
        mean, covariance = np.zeros(b - a), np.zeros((b - a, b - a))
        at = [c - evidence.n_base - a for c in best.free]
        mean[at] = best.mean
        covariance[np.ix_(at, at)] = best.covariance
        findings[name] = finding(effect, best.log_evidence - base.log_evidence, mean, covariance)
        free[name] = tuple(at)
        penalties[name] = sign_penalty(low)
    return Screening(findings, free, penalties)


def naive_answer(mechanics: Mechanics, findings: Mapping[str, Finding]) -> str:
    """The candidate with the largest drop of the training loss: the baseline to beat."""
    evidence = mechanics.evidence
    drops = {name: f.log_evidence for name, f in findings.items() if name not in mechanics.coefficients}
    for name, (a, b) in mechanics.coefficients.items():
        places = list(range(evidence.n_base + a, evidence.n_base + b))
        drop = evidence.loss_drop(places, fitted_discrepancy(mechanics.shooting))
        drops[name] = max(drop, drops.get(name, -np.inf))
    return max(drops, key=lambda name: drops[name])


WIDENED = 2.0
"""See estimates."""


def estimates(found: Finding, effect: Effect, widened: float = WIDENED) -> dict[str, Estimate]:
    """Estimates with 90 % intervals within the bounds.

    Args:
        found: of the effect.
        effect: its parameters.
        widened: factor by which intervals of the linearised model are too narrow.
    """
    out = {}
    for parameter in effect.parameters:
        mean = float(np.clip(found.mean[parameter.name], parameter.low, parameter.high))
        reach = 1.645 * widened * found.deviation[parameter.name]
        out[parameter.name] = Estimate(
            mean,
            float(np.clip(mean - reach, parameter.low, parameter.high)),
            float(np.clip(mean + reach, parameter.low, parameter.high)),
            parameter.unit,
        )
    return out


_DRAWS = 500
"""Of an effect's coefficients, for the intervals of what they come to."""


def amounts(
    found: Finding,
    effect: Effect,
    around: Surroundings,
    material: Mapping[str, float],
    times: Tensor,
    widened: float = WIDENED,
) -> dict[str, Estimate]:
    """What the coefficients come to, with 90 % intervals; {} where they say so themselves.

    Args:
        found: of the effect.
        effect: see Effect.amounts.
        around: the clip whose coefficients they are.
        material: of the cloth, by name, that of the same fit.
        times: of the frames that the coefficients are known from (T,) [s].
        widened: see estimates.
    """
    bounds = [np.array([getattr(p, end) for p in effect.parameters]) for end in ("low", "high")]

    def of(values: Array) -> tuple[Amount, ...]:
        acting = effect.with_values(torch.from_numpy(np.clip(values, *bounds)))
        return acting.amounts(around, material, times)

    mean = np.array([found.mean[parameter.name] for parameter in effect.parameters])
    best = of(mean)
    if not best:
        return {}
    covariance = found.covariance
    if covariance is None:
        covariance = np.diag([found.deviation[parameter.name] ** 2 for parameter in effect.parameters])
    # The same draws every time: an answer made twice is the same. Rounding may leave eigenvalues below zero.
    values, vectors = np.linalg.eigh(0.5 * widened**2 * (covariance + covariance.T))
    normal = np.random.default_rng(0).standard_normal((_DRAWS, len(mean)))
    draws = mean + (normal * np.sqrt(np.clip(values, 0.0, None))) @ vectors.T
    drawn = np.array([[amount.value for amount in of(draw)] for draw in draws])
    at_best = np.array([amount.value for amount in best])
    low, middle, high = np.quantile(drawn, (0.05, 0.5, 0.95), axis=0)
    # The largest of a field grows with every error of it, so what is drawn lies beyond the estimate.
    low, high = low + at_best - middle, high + at_best - middle
    low = np.where(drawn.min(0) >= 0, np.maximum(low, 0.0), low)
    return {
        amount.what: Estimate(amount.value, float(a), float(b), amount.unit)
        for amount, a, b in zip(best, low, high, strict=True)
    }
