"""Evidence against the multivariate normal that it abbreviates."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from toile.diagnosis.continuity import Discrepancy, WindowSystem
from toile.diagnosis.evidence import DEFAULT, Evidence, EvidenceSettings

INTERNAL = np.array([False, False, False, True, False])
EXTERNAL = np.array([False, False, False, False, True])
SIZE = Discrepancy(0.4, 0.1)


def problem(seed: int, true: float):
    """Two windows with 30 measurements each of [2 base | 2 effect | 3 local | 2 forces], noise 1."""
    rng = np.random.default_rng(seed)
    systems, jacobians, data = [], [], []
    for _ in range(2):
        J = rng.normal(size=(30, 9)) * np.array([1, 1, 3, 3, 1, 1, 1, 1, 1])
        y = J[:, 2] * true + J[:, 7:] @ rng.normal(scale=0.05, size=2) + rng.normal(size=30)
        y += J[:, 4:7] @ rng.normal(size=3)
        systems.append(WindowSystem(J.T @ J, -J.T @ y, np.zeros(5), INTERNAL, EXTERNAL, SIZE))
        jacobians.append(J)
        data.append(y)
    return systems, jacobians, data


@pytest.mark.parametrize("free", [(), (0,), (0, 1)])
def test_differences_are_those_of_the_marginal_likelihood(free: tuple[int, ...]) -> None:
    systems, jacobians, data = problem(0, 0.5)
    deviations = np.array([1.0, 2.0])
    evidence = Evidence(systems, np.zeros(2), deviations, EvidenceSettings(prior_inflation=1.5))

    def exact(chosen: tuple[int, ...]) -> float:
        shared = [0, 1, *(2 + c for c in chosen)]
        scale = np.concatenate((deviations, np.full(len(chosen), 1.5)))
        y = np.concatenate(data)
        covariance = np.eye(len(y))
        S = np.concatenate([J[:, shared] for J in jacobians]) * scale
        covariance += S @ S.T
        for w, J in enumerate(jacobians):
            local = J[:, 4:] * np.array([1, 1, 1, *SIZE])
            at = slice(30 * w, 30 * (w + 1))
            covariance[at, at] += local @ local.T
        return float(multivariate_normal(np.zeros(len(y)), covariance).logpdf(y))

    found = evidence._at([2 + c for c in free], SIZE).log_evidence - evidence._at((), SIZE).log_evidence
    assert found == pytest.approx(exact(free) - exact(()), abs=1e-6)


def test_the_true_effect_wins_and_is_measured() -> None:
    systems, _, _ = problem(1, 0.5)
    evidence = Evidence(systems, np.zeros(2), np.ones(2))
    none, right, wrong = (evidence.posterior(c) for c in ((), (2,), (3,)))
    assert right.log_evidence > none.log_evidence + 5
    assert right.log_evidence > wrong.log_evidence + 5
    assert right.mean[0] == pytest.approx(0.5, abs=3 * right.covariance[0, 0] ** 0.5)


def test_an_effect_of_impossible_sign_does_not_win() -> None:
    systems, _, _ = problem(1, -0.5)
    evidence = Evidence(systems, np.zeros(2), np.ones(2))
    free = evidence.signed((2,), np.array([-np.inf]))
    bounded = evidence.signed((2,), np.array([0.0]))
    assert free.log_evidence > evidence.posterior(()).log_evidence + 5
    assert bounded.log_evidence < evidence.posterior(()).log_evidence


@pytest.mark.parametrize("kind", [0, 1])
def test_where_forces_are_missing_the_discrepancy_grows(kind: int) -> None:
    """That of the kind that is missing, to the size of what is; the other one stays as small as it was."""
    systems, jacobians, _ = problem(2, 0.0)
    little = Discrepancy(DEFAULT.internal[0], DEFAULT.external[0])

    def judged(force: float) -> tuple[Discrepancy, float]:
        """Discrepancy with a force [m/s²] in both windows, and what it gains over one that is kept little."""
        missing = [
            replace(s, gradient=s.gradient - J.T @ (J[:, 7 + kind] * force))
            for s, J in zip(systems, jacobians, strict=True)
        ]
        evidence = Evidence(missing, np.zeros(2), np.ones(2))
        best = evidence.posterior(())
        return best.discrepancy, best.log_evidence - evidence.posterior((), little).log_evidence

    quiet, gained = judged(0.0)
    assert quiet == little
    assert gained == pytest.approx(0.0, abs=1e-9)
    for force in (1.0, -1.0):
        size, gained = judged(force)
        assert 0.5 < size[kind] < 2.0
        assert size[1 - kind] == quiet[1 - kind]
        assert gained > 10
    # Much more than the largest that is tried.
    assert judged(30.0)[0][kind] == (DEFAULT.internal[-1], DEFAULT.external[-1])[kind]


@pytest.mark.parametrize("seed", [2, 3, 4])
@pytest.mark.parametrize("largest", [Discrepancy(np.inf, np.inf), Discrepancy(0.2, 0.01)])
def test_the_search_finds_the_best_of_all_discrepancies(seed: int, largest: Discrepancy) -> None:
    systems, _, _ = problem(seed, 0.5)
    evidence = Evidence(systems, np.zeros(2), np.ones(2))
    allowed = [
        Discrepancy(a, b)
        for a in DEFAULT.internal
        for b in DEFAULT.external
        if a <= largest.internal and b <= largest.external
    ]
    alone = [Evidence(systems, np.zeros(2), np.ones(2)) for _ in allowed]
    every = [e._at((2,), size).log_evidence for e, size in zip(alone, allowed, strict=True)]
    assert evidence.posterior((2,), largest).log_evidence == pytest.approx(max(every), abs=1e-9)
    assert len(evidence._reduced) < len(allowed)


def test_determinants_of_the_local_unknowns_may_come_from_elsewhere() -> None:
    """What a motion about to snap through adds to the evidence is none; means stay as they are."""
    systems, _, _ = problem(4, 0.5)
    steep = [replace(s, matrix=s.matrix.copy()) for s in systems]
    for s in steep:
        s.matrix[3:, 3:] += np.eye(len(s.matrix) - 3) * 1e3
    usual = Evidence(systems, np.zeros(2), np.ones(2))
    own = Evidence(steep, np.zeros(2), np.ones(2))
    like = Evidence(steep, np.zeros(2), np.ones(2), like=usual)
    for free in ((), (2,)):
        a, b = own._at(free, SIZE), like._at(free, SIZE)
        np.testing.assert_allclose(b.mean, a.mean)
        shift = own.reduced(SIZE).determinant - usual.reduced(SIZE).determinant
        assert shift > 1
        assert b.log_evidence - a.log_evidence == pytest.approx(shift)


def test_all_the_way_to_the_mean_nothing_costs_less() -> None:
    """Base, effect and local unknowns together."""
    systems, _, _ = problem(3, 0.5)
    evidence = Evidence(systems, np.zeros(2), np.ones(2))
    best = evidence.posterior((2,))
    values, coefficients, changes = evidence.towards(best.free, best.discrepancy, 0.0, np.full(2, np.inf))

    def cost(base: np.ndarray, own: np.ndarray, local: list[np.ndarray]) -> float:
        total = 0.5 * float(base @ base) + 0.5 * float(own @ own) / best.prior_inflation**2
        for s, moved in zip(systems, local, strict=True):
            full = np.concatenate((base, own, [0.0], moved))
            total += float(0.5 * full @ s.matrix @ full + s.gradient @ full)
            standardised = moved / np.array([1, 1, 1, *best.discrepancy])
            total += 0.5 * float(standardised @ standardised)
        return total

    least = cost(values, coefficients, changes)
    rng = np.random.default_rng(0)
    for _ in range(20):
        moved = [c + 1e-2 * rng.normal(size=c.shape) for c in changes]
        base = values + 1e-2 * rng.normal(size=2)
        assert cost(base, coefficients + 1e-2 * rng.normal(size=1), moved) > least
    # With damping it goes part of the way: less the more of it, and downhill all the same.
    before = cost(np.zeros(2), np.zeros(1), [np.zeros_like(c) for c in changes])
    costs = [
        cost(*evidence.towards((2,), best.discrepancy, damping, np.full(2, np.inf)))
        for damping in (0.0, 1.0, 10.0, 1e4)
    ]
    assert costs == sorted(costs)
    assert costs[0] == pytest.approx(least)
    assert costs[-1] < before


def test_many_small_numbers_are_found_at_their_own_scale() -> None:
    """A gust's modes, each far below its prior's width; where nothing is, the scan gains little."""
    rng = np.random.default_rng(5)
    n = 8
    found = {}
    for size in (0.0, 0.05):
        systems = []
        true = size * rng.normal(size=n)
        for _ in range(2):
            J = rng.normal(size=(60, 2 + n + 5)) * np.array([1, 1, *[2.0] * n, 1, 1, 1, 1, 1])
            y = J[:, 2 : 2 + n] @ true + rng.normal(size=60)
            systems.append(WindowSystem(J.T @ J, -J.T @ y, np.zeros(5), INTERNAL, EXTERNAL, SIZE))
        evidence = Evidence(systems, np.zeros(2), np.ones(2))
        free = tuple(range(2, 2 + n))
        base = evidence.posterior(()).log_evidence
        scanned = evidence.signed(free, np.full(n, -np.inf)).log_evidence - base
        found[size] = scanned, evidence.posterior(free).log_evidence - base
    assert found[0.0][0] < 0
    assert found[0.05][1] < 0 < found[0.05][0] - 3


def test_evidence_does_not_depend_on_where_a_quadratic_is_developed() -> None:
    """Around other base values, coefficients of the effect and local unknowns, with their cost beside."""
    systems, _, _ = problem(4, 0.5)
    rng = np.random.default_rng(0)
    deviations, at = np.array([1.0, 2.0]), rng.normal(size=4)
    values, coefficients = at[:2], at[2:]
    moved, cost = [], 0.0
    for s in systems:
        standardised = rng.normal(size=5)
        step = np.concatenate((at, standardised * np.array([1, 1, 1, *SIZE])))
        cost += 0.5 * step @ s.matrix @ step + s.gradient @ step
        moved.append(replace(s, gradient=s.gradient + s.matrix @ step, standardised=standardised))
    here = Evidence(systems, np.zeros(2), deviations)
    there = Evidence(moved, values, deviations, coefficients=coefficients)
    a, b = here.posterior((2, 3)), there.posterior((2, 3))
    assert b.log_evidence - cost == pytest.approx(a.log_evidence, abs=1e-8)
    np.testing.assert_allclose(b.mean, a.mean, atol=1e-8)
    np.testing.assert_allclose(b.covariance, a.covariance, atol=1e-8)


def test_the_way_to_the_mean_is_gone_as_far_as_is_allowed() -> None:
    systems, _, _ = problem(5, 0.5)
    evidence = Evidence(systems, np.zeros(2), np.ones(2))
    best = evidence.posterior((2, 3))
    values, coefficients, _ = evidence.towards(best.free, best.discrepancy, 0.0, np.full(2, np.inf))
    np.testing.assert_allclose(coefficients, best.mean)
    limit = 0.25 * np.abs(values).max()
    shorter, part, _ = evidence.towards(best.free, best.discrepancy, 0.0, np.array([limit, limit]))
    assert np.abs(shorter).max() == pytest.approx(limit)
    np.testing.assert_allclose(part, 0.25 * best.mean)


def test_a_window_that_is_frozen_stays_and_the_others_move() -> None:
    systems, _, _ = problem(3, 0.5)
    evidence = Evidence(systems, np.zeros(2), np.ones(2))
    best = evidence.posterior((2,))
    every = evidence.towards(best.free, best.discrepancy, 0.0, np.full(2, np.inf))[2]
    frozen = np.arange(len(systems)) == 1
    changes = evidence.towards((2,), best.discrepancy, 0.0, np.full(2, np.inf), frozen)[2]
    assert np.abs(changes[1]).max() < 1e-3 * np.abs(every[1]).max()
    assert np.abs(changes[0]).max() > 0.1 * np.abs(every[0]).max()


def test_some_of_the_shared_columns() -> None:
    systems, _, _ = problem(6, 0.5)
    whole = Evidence(systems, np.zeros(2), np.ones(2))
    part = Evidence([s.with_shared((0, 1, 3)) for s in systems], np.zeros(2), np.ones(2))
    assert part.posterior((2,)).log_evidence == pytest.approx(whole.posterior((3,)).log_evidence)
    np.testing.assert_allclose(part.posterior((2,)).mean, whole.posterior((3,)).mean)


def test_discrepancies_and_scales_of_the_settings_are_tried() -> None:
    systems, _, _ = problem(1, 0.5)
    few = EvidenceSettings(internal=(0.4, 0.1), external=(0.1,), many=2, scales=(0.5, 1.0), forbidden=7.0)
    evidence = Evidence(systems, np.zeros(2), np.ones(2), few)
    assert evidence.posterior(()).discrepancy in (Discrepancy(0.4, 0.1), Discrepancy(0.1, 0.1))
    # Whatever their order is; none is as small as this, so the smallest stands for it.
    assert evidence.posterior((), Discrepancy(0.01, 0.01)).discrepancy == Discrepancy(0.1, 0.1)
    both = [
        evidence.posterior((2, 3), prior_inflation=share * few.prior_inflation).log_evidence
        for share in few.scales
    ]
    free = Discrepancy(np.inf, np.inf)
    assert evidence.scaled((2, 3), free).log_evidence == pytest.approx(max(both) - np.log(2))
    # A number that is surely positive and is said to be none.
    turned, _, _ = problem(1, -0.5)
    negative = Evidence(turned, np.zeros(2), np.ones(2), few)
    found = negative.signed((2,), np.zeros(1))
    assert found.log_evidence == pytest.approx(negative.posterior(()).log_evidence - 7.0)
