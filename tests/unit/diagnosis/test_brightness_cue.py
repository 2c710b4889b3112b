"""Light on turning surfaces, from colours at known positions."""

from __future__ import annotations

import numpy as np

from toile.diagnosis.brightness_cue import Brightness, BrightnessSettings, brightness_evidence
from toile.effects.catalogue import CATALOGUE

F, P = 20, 64


def turning(seed: int = 0) -> np.ndarray:
    """Unit normals (F, P, 3) of patches that turn to and fro by some 20°."""
    rng = np.random.default_rng(seed)
    angle = 0.4 * np.sin(0.4 * np.arange(F))[:, None] * rng.uniform(0.5, 1.5, P) + rng.normal(0, 0.2, P)
    tilt = 0.2 * np.cos(0.3 * np.arange(F))[:, None] * rng.uniform(-1, 1, P)
    n = np.stack((np.sin(angle), np.sin(tilt), -np.ones_like(angle)), -1)
    return n / np.linalg.norm(n, axis=-1, keepdims=True)


def seen(brightness: np.ndarray, normals: np.ndarray) -> Brightness:
    return Brightness(brightness, np.ones((F, P)), normals)


def test_shading_explains_what_lambert_makes() -> None:
    normals = turning()
    light = np.array([0.6, -0.3, -0.74])
    lit = 0.3 + 0.7 * np.clip(normals @ light, 0, None)
    noise = np.random.default_rng(1).normal(0, 0.01, (F, P))
    found = brightness_evidence(CATALOGUE["shading"](), seen(np.log(lit / lit[0]) + noise, normals))
    assert found.log_evidence > 20
    assert found.explained > 0.8


def test_noise_and_an_occluder_are_no_light() -> None:
    normals = turning()
    noise = np.random.default_rng(1).normal(0, 0.01, (F, P))
    assert brightness_evidence(CATALOGUE["shading"](), seen(noise, normals)).log_evidence < 0
    passing = noise.copy()
    for f in range(F):
        passing[f, (3 * f) % P : (3 * f) % P + 6] -= 1.0
    occluded = brightness_evidence(CATALOGUE["shading"](), seen(passing, normals))
    assert occluded.explained < 0.3


def test_frames_whose_tracking_is_lost_do_not_decide() -> None:
    normals = turning()
    rng = np.random.default_rng(1)
    still = rng.normal(0, 0.01, (F, P))
    lost = still.copy()
    # Colours of other places, which happen to follow the normals there; all other frames say no.
    lost[-4:] += (normals[-4:] - normals[:1])[..., 0] + rng.normal(0, 0.1, (4, P))
    found = brightness_evidence(CATALOGUE["shading"](), seen(lost, normals))
    assert np.sqrt((lost[-4:] ** 2).mean()) > 0.15
    assert found.log_evidence < 0
    # The very same in all frames is light.
    lit = still + (normals - normals[:1])[..., 0]
    assert brightness_evidence(CATALOGUE["shading"](), seen(lit, normals)).log_evidence > 20


def test_light_is_as_sure_as_the_settings_say() -> None:
    normals = turning()
    light = np.array([0.6, -0.3, -0.74])
    lit = 0.3 + 0.7 * np.clip(normals @ light, 0, None)
    noise = np.random.default_rng(1).normal(0, 0.01, (F, P))
    shown = seen(np.log(lit / lit[0]) + noise, normals)

    def gain(**settings: float) -> float:
        return brightness_evidence(CATALOGUE["shading"](), shown, BrightnessSettings(**settings)).log_evidence

    # Frames that share less of their error say more, brightness that is known worse says less.
    assert gain(shared_error=2.0) > 2 * gain()
    assert gain(noise=0.2) < 0.5 * gain()
