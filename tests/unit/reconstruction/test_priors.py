"""Smoothness priors: standardised coordinates, adjoints, and the paper's quadratic form."""

from __future__ import annotations

import numpy as np
import pytest

from toile.reconstruction.priors import SmoothField, SmoothSeries

RNG = np.random.default_rng(0)


@pytest.mark.parametrize(
    ("prior", "shape"),
    [(SmoothField((5, 4, 6), 3.0, 1.0, 2.0), (5, 4, 6, 3)), (SmoothSeries(7, 0.01, 3.0), (7, 2, 3))],
)
def test_standardised_coordinates(prior: SmoothField | SmoothSeries, shape: tuple[int, ...]) -> None:
    z, g = RNG.normal(size=shape), RNG.normal(size=shape)
    np.testing.assert_allclose(prior.standardise(prior.restored(z)), z, atol=1e-12)
    assert (prior.restored(z) * g).sum() == pytest.approx((z * prior.restored_adjoint(g)).sum(), rel=1e-12)


def test_deviation_is_that_of_the_field() -> None:
    prior = SmoothField((20, 16, 16), 3.0, 1.0, 2.0)
    field = prior.restored(RNG.normal(size=(20, 16, 16, 3)))
    assert np.sqrt((field**2).mean()) == pytest.approx(3.0, rel=0.05)


def test_quadratic_form_is_that_of_the_paper() -> None:
    """½ |z|² is proportional to Eq. 17 with weights 1, l_t², l_s² for free ends."""
    shape, time_scale, space_scale = (5, 4, 6), 0.7, 1.5
    prior = SmoothField(shape, 2.0, time_scale, space_scale)

    def regularisation(field: np.ndarray) -> float:
        total = (field**2).sum()
        total += time_scale**2 * (np.diff(field, axis=0) ** 2).sum()
        return total + space_scale**2 * sum((np.diff(field, axis=a) ** 2).sum() for a in (1, 2))

    ratios = []
    for _ in range(3):
        field = RNG.normal(size=(*shape, 3))
        ratios.append((prior.standardise(field) ** 2).sum() / regularisation(field))
    np.testing.assert_allclose(ratios, ratios[0], rtol=1e-12)
