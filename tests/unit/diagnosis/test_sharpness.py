"""Exposure from smear along the motion."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from toile.diagnosis.sharpness import DEFAULT, ExposureSettings, exposure_evidence, misfits, smear_of
from toile.effects.catalogue import CATALOGUE

N = 192


def seen(exposure: float, *, blur: float = 0.0, shift: float = 0.0) -> np.ndarray:
    """Misfits of a picture that moves to and fro by 4 px per frame along a slanted line."""
    rng = np.random.default_rng(0)
    picture = gaussian_filter(rng.normal(size=(N, N)), 1.5, mode="wrap")
    picture = 0.5 + 0.1 * picture / picture.std()
    i, j = np.meshgrid(np.arange(N), np.arange(N), indexing="ij")
    visible = np.zeros((N, N), bool)
    visible[8:-8, 8:-8] = True
    found = []
    for f in range(1, 10):
        motion = 4 * np.sin(0.6 * f) * np.array([0.8, 0.6])
        ways = np.linspace(-0.5, 0.5, 15) * exposure
        parts = [
            map_coordinates(picture, [i + k * motion[1] + shift, j + k * motion[0]], order=3, mode="wrap")
            for k in ways
        ]
        now = gaussian_filter(np.mean(parts, 0), blur) + rng.normal(0, 0.002, (N, N))
        pixels = np.stack((j, i), -1).astype(float)
        found.append(misfits(now, picture, pixels, np.broadcast_to(motion, pixels.shape), visible))
    return np.concatenate(found, 1)


@pytest.mark.parametrize("exposure", [0.4, 0.8])
def test_exposure_is_found(exposure: float) -> None:
    """With its size, whatever the tracking error."""
    effect = CATALOGUE["motion_blur"]()
    fit = exposure_evidence(effect, smear_of(seen(exposure, shift=0.7)))
    assert fit.log_evidence > 5
    assert float(fit.mean[0] * effect.scales[0]) == pytest.approx(exposure, abs=0.15)


@pytest.mark.parametrize("blur", [0.0, 0.8])
def test_sharp_and_evenly_blurred_frames_are_no_smear(blur: float) -> None:
    """A lens out of focus blurs in all directions."""
    assert exposure_evidence(CATALOGUE["motion_blur"](), smear_of(seen(0.0, blur=blur))).log_evidence < 1.5


def test_too_few_patches_say_nothing() -> None:
    """A cloth at rest cannot tell."""
    assert smear_of(np.zeros((DEFAULT.exposures, 3))).log_evidence == 0.0


def test_patches_count_as_the_settings_say() -> None:
    found = seen(0.4)
    usual = smear_of(found)
    shared = smear_of(found, ExposureSettings(shared_error=2 * DEFAULT.shared_error))
    assert shared.count == pytest.approx(0.5 * usual.count)
    np.testing.assert_array_equal(shared.misfit, usual.misfit)
    assert smear_of(found, ExposureSettings(fewest=found.shape[1] + 1)).log_evidence == 0.0
    np.testing.assert_allclose(ExposureSettings(exposures=5).tried, [0, 0.25, 0.5, 0.75, 1])
    # Where nothing is an outlier, the misfit is the mean square.
    squares = (found**2).mean(1)
    kept = smear_of(found, ExposureSettings(outlier=1e6)).misfit
    np.testing.assert_allclose(kept, squares / squares[0])
