"""Evidence for an effect is that of its prior, averaged over sizes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from toile.diagnosis.effect_evidence import SIZES, EffectEvidence

FITTED = 3.0


def fitted(design: np.ndarray, data: np.ndarray) -> EffectEvidence:
    """Least squares with unit noise under the prior of the fit."""
    n = design.shape[1]
    precision = design.T @ design + np.eye(n) / FITTED**2
    coefficients = np.linalg.solve(precision, design.T @ data)
    rest = data - design @ coefficients
    drop = 0.5 * (data @ data - rest @ rest - coefficients @ coefficients / FITTED**2)
    return EffectEvidence.of(float(drop), coefficients, np.linalg.inv(precision), FITTED)


def log_marginal(design: np.ndarray, data: np.ndarray, size: float) -> float:
    eye = np.eye(len(data))
    with_effect = multivariate_normal(cov=eye + size**2 * design @ design.T).logpdf(data)
    return float(with_effect - multivariate_normal(cov=eye).logpdf(data))


@pytest.mark.parametrize("strength", [0.0, 0.3, 2.0])
def test_it_is_the_marginal_likelihood_averaged_over_sizes(strength: float) -> None:
    rng = np.random.default_rng(1)
    design = rng.normal(size=(30, 6))
    data = design @ (strength * rng.normal(size=6)) + rng.normal(size=30)
    expected = logsumexp([log_marginal(design, data, size) for size in SIZES]) - np.log(len(SIZES))
    assert fitted(design, data).nats() == pytest.approx(expected, abs=1e-6)


def test_misfits_that_are_too_large_count_for_less() -> None:
    rng = np.random.default_rng(2)
    design = rng.normal(size=(40, 5))
    data = 2 * (design @ np.ones(5) + rng.normal(size=40))
    # Twice the noise is four times the misfit.
    assert fitted(design, data).nats(4.0) == pytest.approx(fitted(design / 2, data / 2).nats(), abs=1e-6)


def test_many_weak_coefficients_are_not_charged_for_strong_ones() -> None:
    rng = np.random.default_rng(3)
    design = 10 * rng.normal(size=(120, 60))
    data = design @ (0.02 * rng.normal(size=60)) + rng.normal(size=120)
    found = fitted(design, data)
    assert found.drop - found.occam < 0
    assert found.nats() > 20


def test_nothing_gains_nothing() -> None:
    rng = np.random.default_rng(4)
    found = [fitted(10 * rng.normal(size=(120, 60)), rng.normal(size=120)).nats() for _ in range(5)]
    assert max(found) < 3
