"""Smear along the motion: how long a frame gathers light.

A moving cloth is smeared along its motion in the image and stays sharp across it. What is compared is
therefore the ratio of squared derivatives along and across the motion, in a frame and in frame 0 at the
same places of the cloth: shifts by tracking errors, brightness and blur in all directions do not change it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates

from toile.effects.base import ExposureEffect
from toile.fitting.reconstruction import Reconstruction
from toile.fitting.terms.texture_points import grid_points

Array = NDArray[np.float64]

EXPOSURES = np.linspace(0, 1, 11)
"""Shares of the time between two frames that are tried."""

_LATTICE = 192
_KNOWN = 48
_PATCHES = 8
_SAMPLES = 9
# Pixels: blur that makes frame 0 and a frame seen from another side alike; slowest motion worth a look.
_BLUR = 1.2
_SLOWEST = 1.0
# Patches side by side and frames in a row show the same texture.
_SHARED_ERROR = 12.0
# Frames: neighbours say the same.
_EVERY = 2
_FEWEST = 50


@dataclass(frozen=True)
class Smear:
    """What the sharpness says about exposure.

    Attributes:
        misfit: mean robust squared misfit at every exposure tried, relative to that at zero.
        count: independent patches.
    """

    misfit: Array
    count: float

    @property
    def exposure(self) -> float:
        """The exposure that fits best [share of the time between frames]."""
        return float(EXPOSURES[int(self.misfit.argmin())])

    @property
    def log_evidence(self) -> float:
        """Against sharp frames, exposure integrated over [0, 1]."""
        if self.count <= 0:
            return 0.0
        return float(np.log(np.mean(np.exp(np.minimum(self._gains(), 500)))))

    def moments(self) -> tuple[float, float]:
        """Mean and deviation of the exposure."""
        weights = np.exp(self._gains() - self._gains().max())
        weights /= weights.sum()
        mean = float(weights @ EXPOSURES)
        # A grid cannot know it better than its spacing.
        spacing = float(EXPOSURES[1] - EXPOSURES[0])
        return mean, float(np.sqrt(weights @ (EXPOSURES - mean) ** 2 + spacing**2 / 12))

    def _gains(self) -> Array:
        return np.asarray(-0.5 * self.count * np.log(np.maximum(self.misfit, 1e-12)))


@dataclass(frozen=True)
class ExposureFit:
    """How well an exposure explains the sharpness.

    Attributes:
        log_evidence: against sharp frames.
        mean, covariance: of the effect's number in units of its prior deviation, (1,), (1, 1).
    """

    log_evidence: float
    mean: Array
    covariance: Array


def exposure_evidence(effect: ExposureEffect, seen: Smear) -> ExposureFit:
    """Evidence that frames are smeared along the motion."""
    mean, deviation = seen.moments()
    scale = float(effect.scales[0])
    return ExposureFit(seen.log_evidence, np.array([mean / scale]), np.array([[(deviation / scale) ** 2]]))


def smear(reconstruction: Reconstruction, positions: Array) -> Smear:
    """Compare sharpness along and across the motion at tracked positions of the first frames (F, N, 3)."""
    scene = reconstruction.scene
    pixels = _pixels(reconstruction, positions)
    grey = scene.frames[: len(positions)].numpy().mean(-1).astype(np.float64)
    masks = gaussian_filter(scene.masks[: len(positions)].numpy().astype(np.float64), (0, 2, 2))
    reference = _sampled(grey[0], pixels[0])
    shown = _sampled(masks[0], pixels[0]) > 0.97
    motion = np.gradient(pixels, axis=0)
    found = []
    for f in range(1, len(positions), _EVERY):
        if np.sqrt((motion[f] ** 2).sum(-1).mean()) < _SLOWEST:
            continue
        visible = shown & (_sampled(masks[f], pixels[f]) > 0.97)
        found.append(misfits(_sampled(grey[f], pixels[f]), reference, pixels[f], motion[f], visible))
    return smear_of(np.concatenate(found, 1) if found else np.zeros((len(EXPOSURES), 0)))


def smear_of(misfits: Array) -> Smear:
    """Smear from the misfits of many patches (n_exposures, n)."""
    if misfits.shape[1] < _FEWEST:
        return Smear(np.ones(len(EXPOSURES)), 0.0)
    spread = 1.5 * 1.48 * float(np.median(np.abs(misfits[0] - np.median(misfits[0]))))
    large = np.abs(misfits)
    robust = np.where(large < spread, misfits**2, spread * (2 * large - spread)).mean(1)
    return Smear(robust / max(robust[0], 1e-12), misfits.shape[1] / _SHARED_ERROR)


def misfits(now: Array, reference: Array, pixels: Array, motion: Array, visible: NDArray[np.bool_]) -> Array:
    """Log ratio of squared derivatives along over across the motion, frame minus smeared frame 0.

    Args:
        now: colours of the frame on the lattice (n, n).
        reference: those of frame 0.
        pixels: where the lattice is in the frame (n, n, 2) [px].
        motion: between two frames (n, n, 2) [px].
        visible: (n, n).

    Returns:
        (n_exposures, n) of the patches that are seen and move.
    """
    down, right = np.asarray(np.gradient(pixels, axis=0)), np.asarray(np.gradient(pixels, axis=1))
    area = down[..., 0] * right[..., 1] - right[..., 0] * down[..., 1]
    speed = np.linalg.norm(motion, axis=-1)
    usual = float(np.median(area))
    visible = visible & (area / usual > 0.3) & (speed > 0.5 * _SLOWEST)
    safe = np.where(np.abs(area) > 1e-6, area, 1.0)
    along = motion / np.maximum(speed, 1e-6)[..., None]
    across = np.stack((-along[..., 1], along[..., 0]), -1)

    def on_lattice(d: Array) -> tuple[Array, Array]:
        """The same direction in lattice steps per pixel."""
        return (
            (right[..., 1] * d[..., 0] - right[..., 0] * d[..., 1]) / safe,
            (down[..., 0] * d[..., 1] - down[..., 1] * d[..., 0]) / safe,
        )

    a, b = on_lattice(along), on_lattice(across)

    def ratio(image: Array) -> Array:
        gi, gj = np.gradient(gaussian_filter(image, _BLUR))
        squares = [_patch_means(((d[0] * gi + d[1] * gj) ** 2) * visible) for d in (a, b)]
        return np.asarray(np.log(squares[0] + _DARK) - np.log(squares[1] + _DARK))

    i, j = np.meshgrid(np.arange(_LATTICE), np.arange(_LATTICE), indexing="ij")

    def smeared(exposure: float) -> Array:
        ways = exposure * np.linspace(-0.5, 0.5, _SAMPLES)
        parts = [
            map_coordinates(reference, [i + k * speed * a[0], j + k * speed * a[1]], order=1, mode="nearest")
            for k in ways
        ]
        return np.asarray(np.mean(parts, 0))

    seen = _patch_means(visible.astype(np.float64)) > 0.7
    observed = ratio(now)
    return np.stack([(observed - ratio(smeared(e) if e > 0 else reference))[seen] for e in EXPOSURES])


def _pixels(reconstruction: Reconstruction, positions: Array) -> Array:
    """Where a fine lattice over the cloth is seen (F, n, n, 2) [px]."""
    scene = reconstruction.scene
    points = grid_points(scene.grid, _KNOWN, 0.0, 0)
    at = torch.from_numpy(points.positions(positions))
    known = scene.camera.project(at).numpy().reshape(len(positions), _KNOWN, _KNOWN, 2)
    line = (np.arange(_LATTICE) + 0.5) / _LATTICE * _KNOWN - 0.5
    where = np.meshgrid(line, line, indexing="ij")
    fine = [[map_coordinates(k[..., c], where, order=1, mode="nearest") for c in (0, 1)] for k in known]
    return np.moveaxis(np.array(fine, np.float64), 1, -1)


def _sampled(image: Array, pixels: Array) -> Array:
    """Values at pixels (..., 2)."""
    where = [pixels[..., 1] - 0.5, pixels[..., 0] - 0.5]
    return np.asarray(map_coordinates(image, where, order=1, mode="nearest"))


def _patch_means(a: Array) -> Array:
    side = _LATTICE // _PATCHES
    return np.asarray(a.reshape(_PATCHES, side, _PATCHES, side).mean((1, 3)))


# Squared derivative of grey in [0, 1] below which there is no texture.
_DARK = 1e-7
