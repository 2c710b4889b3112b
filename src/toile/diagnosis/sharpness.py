"""Smear along the motion: how long a frame gathers light.

A moving cloth is smeared along its motion in the image and stays sharp across it. What is compared is
therefore the ratio of squared derivatives along and across the motion, in a frame and in frame 0 at the
same places of the cloth: shifts by tracking errors, brightness and blur in all directions do not change it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from scipy.ndimage import gaussian_filter, map_coordinates

from toile.effects.base import ExposureEffect
from toile.limits import Count, Fraction, NonNegative, Positive, Unit
from toile.reconstruction.image_terms.texture_points import grid_points
from toile.reconstruction.problem import Reconstruction

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ExposureSettings:
    """How smear along the motion is measured, and how much its measurements count.

    Attributes:
        exposures: how many are tried, evenly from 0 to the whole time between two frames.
        samples: moments within an exposure that are averaged.
        patches: along each side of the cloth; sharpness is that of a patch.
        per_patch: points along each side of a patch at which frames are read.
        known: points along each side of the cloth whose place in the image is computed; those between are
            interpolated.
        blur: σ in points of the lattice, that makes frame 0 and a frame seen from another side alike.
        slowest: root mean square motion of a frame from which on it is looked at, and twice that of a point
            which counts [px/frame].
        every: of how many frames one is looked at; neighbours say the same.
        mask_smoothing: σ of the blur of the masks [px].
        inside: share of the cloth within that blur around a point, from which on the point counts.
        flattest: area that a cell of the lattice has in the image, over the median one, to count.
        shown: share of a patch that must count for the patch to count.
        dark: squared derivative of grey in [0, 1] below which there is no texture.
        outlier: deviations from which on a patch counts as an outlier (Huber).
        shared_error: patches that err as one: side by side, and in frames in a row, they show one texture.
        fewest: patches below which nothing is said.
    """

    exposures: Annotated[int, Field(ge=2)] = 11
    samples: Count = 9
    patches: Count = 8
    per_patch: Count = 24
    known: Count = 48
    blur: NonNegative = 1.2
    slowest: Annotated[Positive, Unit("px/frame")] = 1.0
    every: Count = 2
    mask_smoothing: Annotated[NonNegative, Unit("px")] = 2.0
    inside: Fraction = 0.97
    flattest: Fraction = 0.3
    shown: Fraction = 0.7
    dark: Positive = 1e-7
    outlier: Positive = 1.5
    shared_error: Positive = 12.0
    fewest: Count = 50

    @property
    def lattice(self) -> int:
        """Points along each side of the cloth."""
        return self.patches * self.per_patch

    @property
    def tried(self) -> Array:
        """Shares of the time between two frames (n,)."""
        return np.linspace(0, 1, self.exposures)


DEFAULT = ExposureSettings()


@dataclass(frozen=True)
class Smear:
    """What the sharpness says about exposure.

    Attributes:
        exposures: that were tried (n,) [share of the time between two frames].
        misfit: mean robust squared misfit at each (n,), relative to that at zero.
        count: independent patches.
    """

    exposures: Array
    misfit: Array
    count: float

    @property
    def exposure(self) -> float:
        """The exposure that fits best [share of the time between frames]."""
        return float(self.exposures[int(self.misfit.argmin())])

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
        mean = float(weights @ self.exposures)
        # A grid cannot know it better than its spacing.
        spacing = float(self.exposures[1] - self.exposures[0])
        return mean, float(np.sqrt(weights @ (self.exposures - mean) ** 2 + spacing**2 / 12))

    def _gains(self) -> Array:
        return np.asarray(-0.5 * self.count * np.log(np.maximum(self.misfit, 1e-12)))


@dataclass(frozen=True)
class ExposureFit:
    """How well an exposure explains the sharpness.

    Attributes:
        log_evidence: against sharp frames.
        mean, covariance: of the effect's coefficient in units of its prior deviation, (1,), (1, 1).
    """

    log_evidence: float
    mean: Array
    covariance: Array


def exposure_evidence(effect: ExposureEffect, seen: Smear) -> ExposureFit:
    """Evidence that frames are smeared along the motion."""
    mean, deviation = seen.moments()
    scale = float(effect.scales[0])
    return ExposureFit(seen.log_evidence, np.array([mean / scale]), np.array([[(deviation / scale) ** 2]]))


def smear(reconstruction: Reconstruction, positions: Array, settings: ExposureSettings = DEFAULT) -> Smear:
    """Compare sharpness along and across the motion at tracked positions of the first frames (F, N, 3)."""
    scene = reconstruction.scene
    pixels = _pixels(reconstruction, positions, settings)
    grey = scene.frames[: len(positions)].numpy().mean(-1).astype(np.float64)
    masks = gaussian_filter(
        scene.masks[: len(positions)].numpy().astype(np.float64),
        (0, settings.mask_smoothing, settings.mask_smoothing),
    )
    reference = _sampled(grey[0], pixels[0])
    shown = _sampled(masks[0], pixels[0]) > settings.inside
    motion = np.gradient(pixels, axis=0)
    found = []
    for f in range(1, len(positions), settings.every):
        if np.sqrt((motion[f] ** 2).sum(-1).mean()) < settings.slowest:
            continue
        visible = shown & (_sampled(masks[f], pixels[f]) > settings.inside)
        now = _sampled(grey[f], pixels[f])
        found.append(misfits(now, reference, pixels[f], motion[f], visible, settings))
    return smear_of(np.concatenate(found, 1) if found else np.zeros((settings.exposures, 0)), settings)


def smear_of(misfits: Array, settings: ExposureSettings = DEFAULT) -> Smear:
    """Smear from the misfits of many patches (n_exposures, n)."""
    if misfits.shape[1] < settings.fewest:
        return Smear(settings.tried, np.ones(settings.exposures), 0.0)
    # 1.48 times the median of the distances is a deviation.
    spread = settings.outlier * 1.48 * float(np.median(np.abs(misfits[0] - np.median(misfits[0]))))
    large = np.abs(misfits)
    robust = np.where(large < spread, misfits**2, spread * (2 * large - spread)).mean(1)
    count = misfits.shape[1] / settings.shared_error
    return Smear(settings.tried, robust / max(robust[0], 1e-12), count)


def misfits(
    now: Array,
    reference: Array,
    pixels: Array,
    motion: Array,
    visible: NDArray[np.bool_],
    settings: ExposureSettings = DEFAULT,
) -> Array:
    """Log ratio of squared derivatives along over across the motion, frame minus smeared frame 0.

    Args:
        now: colours of the frame on the lattice (n, n).
        reference: those of frame 0.
        pixels: where the lattice is in the frame (n, n, 2) [px].
        motion: between two frames (n, n, 2) [px].
        visible: (n, n).
        settings: see ExposureSettings; n is its lattice.

    Returns:
        (n_exposures, n) of the patches that are seen and move.
    """
    down, right = np.asarray(np.gradient(pixels, axis=0)), np.asarray(np.gradient(pixels, axis=1))
    area = down[..., 0] * right[..., 1] - right[..., 0] * down[..., 1]
    speed = np.linalg.norm(motion, axis=-1)
    usual = float(np.median(area))
    visible = visible & (area / usual > settings.flattest) & (speed > 0.5 * settings.slowest)
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
        gi, gj = np.gradient(gaussian_filter(image, settings.blur))
        squares = [_patch_means(((d[0] * gi + d[1] * gj) ** 2) * visible, settings) for d in (a, b)]
        return np.asarray(np.log(squares[0] + settings.dark) - np.log(squares[1] + settings.dark))

    i, j = np.meshgrid(np.arange(settings.lattice), np.arange(settings.lattice), indexing="ij")

    def smeared(exposure: float) -> Array:
        ways = exposure * np.linspace(-0.5, 0.5, settings.samples)
        parts = [
            map_coordinates(reference, [i + k * speed * a[0], j + k * speed * a[1]], order=1, mode="nearest")
            for k in ways
        ]
        return np.asarray(np.mean(parts, 0))

    seen = _patch_means(visible.astype(np.float64), settings) > settings.shown
    observed = ratio(now)
    return np.stack([(observed - ratio(smeared(e) if e > 0 else reference))[seen] for e in settings.tried])


def _pixels(reconstruction: Reconstruction, positions: Array, settings: ExposureSettings) -> Array:
    """Where a fine lattice over the cloth is seen (F, n, n, 2) [px]."""
    scene = reconstruction.scene
    n, m = settings.lattice, settings.known
    points = grid_points(scene.grid, m, 0.0, 0)
    at = torch.from_numpy(points.positions(positions))
    known = scene.camera.project(at).numpy().reshape(len(positions), m, m, 2)
    line = (np.arange(n) + 0.5) / n * m - 0.5
    where = np.meshgrid(line, line, indexing="ij")
    fine = [[map_coordinates(k[..., c], where, order=1, mode="nearest") for c in (0, 1)] for k in known]
    return np.moveaxis(np.array(fine, np.float64), 1, -1)


def _sampled(image: Array, pixels: Array) -> Array:
    """Values at pixels (..., 2)."""
    where = [pixels[..., 1] - 0.5, pixels[..., 0] - 0.5]
    return np.asarray(map_coordinates(image, where, order=1, mode="nearest"))


def _patch_means(a: Array, settings: ExposureSettings) -> Array:
    n, side = settings.patches, settings.per_patch
    return np.asarray(a.reshape(n, side, n, side).mean((1, 3)))
