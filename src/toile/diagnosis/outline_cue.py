"""The outline in frame 0, where the cloth is known: it tells a wrong camera and a wrong mask apart.

Frame 0 is the template, so its outline has a place in the image without any fit. The signed distance from
there to the mask's edge is noise for a right camera and a right mask, constant for a grown mask, and grows
with the distance from the principal point for a wrong focal length or a distorted lens.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from scipy.ndimage import distance_transform_edt, map_coordinates

from toile.diagnosis.effect_sensitivities import derivatives
from toile.effects.base import CameraEffect, Effect, MaskEffect
from toile.limits import Count, NonNegative, Positive, Unit
from toile.scenes.scene import Scene

Array = NDArray[np.float64]


@dataclass(frozen=True)
class OutlineSettings:
    """How the outline of frame 0 is measured, and which errors of it are usual.

    Attributes:
        raster: deviations [px] of a distance to an edge that is drawn in whole pixels; the likeliest counts.
        ragged: further ones [px], of ragged masks and of templates that do not quite fit.
        ragged_against_camera: log evidence that a wrong camera loses with one of those: a wrong mask is often
            ragged, but a wrong camera leaves a smooth outline smooth.
        least_reach: how far a normal is followed to both sides of the nearest edge, at least [px].
        reach: the same in multiples of the distance to that edge.
        steps: places along a normal that are looked at.
        correlation: points of the outline closer than this share their error [px].
        fewest: independent points that any outline has, however short it is.
        strengths: by how much stronger than its prior deviations say an effect may be; one is chosen and
            penalised for. Else the next best effect takes up what the prior forbids the right one.
    """

    raster: Annotated[tuple[Positive, ...], Field(min_length=1), Unit("px")] = (0.2, 0.27, 0.37, 0.5)
    ragged: Annotated[tuple[Positive, ...], Unit("px")] = (0.75, 1.1, 1.6, 2.4, 3.5, 5.0)
    ragged_against_camera: NonNegative = 6.0
    least_reach: Annotated[Positive, Unit("px")] = 3.0
    reach: Positive = 2.5
    steps: Count = 100
    correlation: Annotated[Positive, Unit("px")] = 12.0
    fewest: Positive = 8.0
    strengths: Annotated[tuple[Positive, ...], Field(min_length=1)] = (1.0, 3.0, 10.0)


DEFAULT = OutlineSettings()


@dataclass(frozen=True)
class Outline:
    """Outline points of frame 0.

    Attributes:
        pixels: (n, 2) [px].
        normals: (n, 2) outwards.
        distances: (n,) [px] by which the mask reaches beyond them.
        independent: number of points that err on their own.
    """

    pixels: Array
    normals: Array
    distances: Array
    independent: float


def template_outline(scene: Scene, settings: OutlineSettings = DEFAULT) -> Outline:
    """Outline of the template and its distance to the first mask."""
    pixels = scene.camera.project(scene.template).numpy().astype(np.float64)
    p = pixels
    along = (p[0, 2:] - p[0, :-2], p[-1, 2:] - p[-1, :-2], p[2:, 0] - p[:-2, 0], p[2:, -1] - p[:-2, -1])
    inner = (
        p[1, 1:-1] - p[0, 1:-1],
        p[-2, 1:-1] - p[-1, 1:-1],
        p[1:-1, 1] - p[1:-1, 0],
        p[1:-1, -2] - p[1:-1, -1],
    )
    at = np.concatenate((p[0, 1:-1], p[-1, 1:-1], p[1:-1, 0], p[1:-1, -1]))
    tangent = np.concatenate(along)
    n = np.stack((tangent[:, 1], -tangent[:, 0]), 1)
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    n *= -np.sign((n * np.concatenate(inner)).sum(1, keepdims=True))
    distances = _beyond(scene.masks[0].numpy() > 0.5, at, n, settings)
    length = float(np.linalg.norm(tangent, axis=1).sum() / 2)
    independent = max(settings.fewest, min(float(len(at)), length / settings.correlation))
    return Outline(at, n, distances, independent)


def _beyond(mask: NDArray[np.bool_], at: Array, normals: Array, settings: OutlineSettings) -> Array:
    """How far the mask reaches beyond points of the outline (n,) [px], on the mean over what is ragged."""
    # Distance to the edge between pixels: half a pixel off the centres on both sides of it.
    signed = np.where(mask, distance_transform_edt(mask) - 0.5, 0.5 - distance_transform_edt(~mask))
    nearest = _sample(signed, at)
    # The nearest edge of a ragged mask is nearer than the mean one, which its length along the normal gives.
    reach = np.maximum(settings.least_reach, settings.reach * np.abs(nearest))
    steps = (np.arange(settings.steps) + 0.5) / settings.steps * 2 - 1
    away = nearest + steps[:, None] * reach
    along = at + away[:, :, None] * normals
    inside = _sample(mask.astype(np.float64), along.reshape(-1, 2)).reshape(away.shape)
    mean = nearest + reach * (2 * inside.mean(0) - 1)
    # Not at corners, where the normal passes the mask by.
    ends = (inside[0] > 0.5) & (inside[-1] < 0.5)
    return np.asarray(np.where(ends, mean, nearest))


def _sample(image: Array, at: Array) -> Array:
    """Values (n,) at pixels (n, 2)."""
    return np.asarray(map_coordinates(image, [at[:, 1] - 0.5, at[:, 0] - 0.5], order=1, mode="nearest"))


def outline_sensitivities(effect: Effect, scene: Scene, at: Outline) -> Array:
    """Change of the distances (n, n_parameters) per prior deviation of an effect's coefficients, at zero."""
    if isinstance(effect, MaskEffect):

        def grown(acting: Effect) -> torch.Tensor:
            assert isinstance(acting, MaskEffect)
            return acting.growth()

        return np.outer(np.ones(len(at.distances)), derivatives(grown, effect))
    if isinstance(effect, CameraEffect):
        pixels = torch.from_numpy(at.pixels)

        def moved(acting: Effect) -> torch.Tensor:
            assert isinstance(acting, CameraEffect)
            return acting.pixels(pixels, scene.camera)

        return np.asarray(np.einsum("nk,pnk->np", at.normals, derivatives(moved, effect)))
    return np.zeros((len(at.distances), len(effect.scales)))


@dataclass(frozen=True)
class OutlineFit:
    """How well an effect explains the outline.

    Attributes:
        log_evidence: against no effect.
        mean, covariance: of its coefficients in units of their prior deviations.
    """

    log_evidence: float
    mean: Array
    covariance: Array


def outline_evidence(
    effect: Effect, scene: Scene, at: Outline, settings: OutlineSettings = DEFAULT
) -> OutlineFit:
    """Evidence of an effect of the camera or the mask from the outline of frame 0."""
    share = at.independent / len(at.distances)
    masked = isinstance(effect, MaskEffect)
    noises = [(noise, 0.0) for noise in settings.raster]
    noises += [(noise, 0.0 if masked else settings.ragged_against_camera) for noise in settings.ragged]
    null = max(_log_likelihood(at.distances, noise, share) for noise, _ in noises)
    sensitivities = outline_sensitivities(effect, scene, at)
    if not sensitivities.any():
        return OutlineFit(0.0, np.zeros(sensitivities.shape[1]), np.eye(sensitivities.shape[1]))
    best: OutlineFit | None = None
    for strength, (noise, penalty) in itertools.product(settings.strengths, noises):
        J = strength * sensitivities
        H = np.eye(J.shape[1]) + share * J.T @ J / noise**2
        covariance = np.linalg.inv(H)
        mean = covariance @ (share * J.T @ at.distances / noise**2)
        left = _log_likelihood(at.distances - J @ mean, noise, share)
        value = left - 0.5 * float(mean @ mean) - 0.5 * float(np.linalg.slogdet(H)[1])
        value -= penalty + math.log(len(settings.strengths))
        if best is None or value - null > best.log_evidence:
            best = OutlineFit(value - null, strength * mean, strength**2 * np.asarray(covariance, np.float64))
    assert best is not None
    return best


def _log_likelihood(distances: Array, noise: float, share: float) -> float:
    return share * float((-0.5 * (distances / noise) ** 2 - np.log(noise)).sum())
