"""What the values of an effect come to, as one would measure it at the cloth."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from toile.diagnosis.findings import Finding, amounts, finding
from toile.effects.air_drag import AirDrag
from toile.effects.base import Surroundings
from toile.effects.gusts import Gusts
from toile.effects.modes import SmoothField
from toile.effects.nonuniform_density import NonuniformDensity
from toile.effects.nonuniform_stiffness import NonuniformStiffness
from toile.effects.rest_curvature import RestCurvature
from toile.physics.cloth import grid_cloth
from toile.physics.grid_lines import GridLines

GRID, SIZE = (41, 31), (0.4, 0.5)
CLOTH = grid_cloth(GRID, SIZE, 0.15, (0, GRID[1] - 1))
AROUND = Surroundings(CLOTH, SIZE, torch.tensor([0.0, 9.81, 0.0], dtype=torch.float64), 50.0, 51)
MATERIAL = {"bending": 2e-4}
TIMES = AROUND.frame_times()


@pytest.mark.parametrize("kind", [NonuniformDensity, NonuniformStiffness])
def test_a_field_says_what_its_extreme_places_have(kind: type[SmoothField]) -> None:
    """A half wave from end to end: its lowest twentieth ends at cos(0.95 pi)."""
    low, high = kind({"mode_10": -0.7}).amounts(AROUND, MATERIAL, TIMES)
    assert (low.what, high.what) == kind.ENDS
    end = math.cos(0.05 * math.pi)
    assert low.value == pytest.approx(100 * math.expm1(-0.7 * end), abs=1.0)
    assert high.value == pytest.approx(100 * math.expm1(0.7 * end), abs=1.0)
    assert (low.unit, high.unit) == ("%", "%")


def test_the_strongest_gust_is_a_length_within_the_clip() -> None:
    (found,) = Gusts({"x_1": 3.0, "z_1": -4.0, "x_2": 0.0}).amounts(AROUND, MATERIAL, TIMES)
    assert found == ("strongest gust", pytest.approx(5.0), "m/s²")


def test_a_gust_is_none_of_frames_that_no_fit_has_seen() -> None:
    """There its cosines say what the fit has asked of other frames."""
    gusts = Gusts({"x_1": 3.0, "x_2": 3.0})
    (seen,) = gusts.amounts(AROUND, MATERIAL, TIMES[20:])
    assert seen.value == pytest.approx(float(gusts.acceleration(TIMES[20:], AROUND).norm(dim=-1).max()))
    assert seen.value < 4.0
    (whole,) = gusts.amounts(AROUND, MATERIAL, TIMES)
    assert whole.value == pytest.approx(6.0)


@pytest.mark.parametrize("mode", ["mode_11", "mode_20"])
def test_places_are_shares_of_the_cloth_and_not_of_its_vertices(mode: str) -> None:
    """Lines of a session's model are closer at the borders, where modes have their extremes."""
    effect = NonuniformDensity({mode: 0.6})
    crowded = grid_cloth((20, 20), SIZE, 0.15, (0, 19), lines=GridLines.crowded(20, 20, 0.5))
    fine = grid_cloth((80, 80), SIZE, 0.15, (0, 79))
    of_both = [
        [one.value for one in effect.amounts(replace(AROUND, cloth=cloth), MATERIAL, TIMES)]
        for cloth in (crowded, fine)
    ]
    np.testing.assert_allclose(of_both[0], of_both[1], atol=1.5)
    assert float(crowded.lines.areas().sum()) == pytest.approx(1.0)


def test_a_moment_curls_cloth_the_more_the_softer_it_is() -> None:
    effect = RestCurvature({"axis_0": 1e-3, "axis_1": -2e-3})
    (found,) = effect.amounts(AROUND, MATERIAL, TIMES)
    assert found.value == pytest.approx(10.0)
    assert found.unit == "1/m"
    (softer,) = effect.amounts(AROUND, {"bending": 1e-4}, TIMES)
    assert softer.value == pytest.approx(20.0)


def of(covariance: np.ndarray) -> Finding:
    """Of the two longest modes alone, the same estimates of both."""
    effect = NonuniformDensity()
    mean = np.zeros(len(effect.scales))
    mean[:2] = 4.0
    whole = np.zeros((len(mean), len(mean)))
    whole[:2, :2] = covariance
    return finding(effect, 30.0, mean, whole)


def test_intervals_know_what_is_only_known_together() -> None:
    """Modes that stand for one another are each unsure, and their sum, at a corner, is not."""
    apart = np.eye(2)
    together = np.array([[1.0, -0.99], [-0.99, 1.0]])
    widths = []
    for covariance in (apart, together):
        found = amounts(of(covariance), NonuniformDensity(), AROUND, MATERIAL, TIMES, widened=1.0)
        heaviest = found["heaviest places"]
        assert heaviest.low <= heaviest.estimate <= heaviest.high
        assert (
            heaviest
            == amounts(of(covariance), NonuniformDensity(), AROUND, MATERIAL, TIMES, widened=1.0)[
                "heaviest places"
            ]
        )
        widths.append(heaviest.high - heaviest.low)
    assert widths[1] < 0.5 * widths[0]


def test_intervals_hold_the_share_that_they_say() -> None:
    """Cloths drawn from what is known of one: a tenth of them lies outside."""
    effect, scales = NonuniformDensity(), NonuniformDensity().scales.numpy()
    # Far from none, so that the largest of a field is where it is whatever is drawn.
    mean, covariance = np.array([3.0, 2.0, 0.0, 0.0, 0.0]), 0.04 * np.eye(5)
    found = amounts(finding(effect, 30.0, mean, covariance), effect, AROUND, MATERIAL, TIMES, widened=1.0)
    draws = np.random.default_rng(7).multivariate_normal(mean, covariance, 400) * scales
    heaviest = [
        effect.with_values(torch.from_numpy(v)).amounts(AROUND, MATERIAL, TIMES)[1].value for v in draws
    ]
    interval = found["heaviest places"]
    outside = np.mean([not interval.low <= value <= interval.high for value in heaviest])
    assert 0.06 < outside < 0.15


def test_what_says_so_itself_comes_to_nothing_more() -> None:
    drag = AirDrag()
    found = finding(drag, 30.0, np.ones(len(drag.scales)), np.eye(len(drag.scales)))
    assert amounts(found, drag, AROUND, MATERIAL, TIMES) == {}


def test_an_estimate_lies_within_its_interval_where_much_is_unsure() -> None:
    """Of a field with errors the largest place has more than the largest of the field itself."""
    effect = NonuniformDensity(half_waves=3)
    mean = np.zeros(len(effect.scales))
    mean[0] = 1.0
    found = amounts(finding(effect, 30.0, mean, 0.3 * np.eye(len(mean))), effect, AROUND, MATERIAL, TIMES)
    for one in found.values():
        assert one.low < one.estimate < one.high
        shorter, longer = sorted((one.estimate - one.low, one.high - one.estimate))
        assert shorter > 0.1 * longer
    gusts = Gusts({"x_1": 0.1})
    unsure = finding(gusts, 1.0, gusts.values.numpy(), np.eye(len(gusts.scales)))
    (strongest,) = amounts(unsure, gusts, AROUND, MATERIAL, TIMES).values()
    assert strongest.low == 0.0


def test_rounding_in_a_covariance_says_nothing() -> None:
    """Coefficients that are not known apart leave eigenvalues of nearly zero, of either sign."""
    mean = np.array([2.0, 1.0, 0.0, 0.0, 0.0])
    along = np.outer(mean, mean) - 1e-12 * np.eye(5)
    effect = NonuniformDensity()
    found = amounts(finding(effect, 30.0, mean, along), effect, AROUND, MATERIAL, TIMES)
    assert all(one.low < one.estimate < one.high for one in found.values())
