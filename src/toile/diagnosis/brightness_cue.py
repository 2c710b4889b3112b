"""Changes of brightness on the cloth: light leaves traces there that no motion does.

Colours are read at the tracked positions, on a lattice that moves with the cloth, and compared with frame 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import torch
from numpy.typing import NDArray

from toile.diagnosis.effect_sensitivities import derivatives
from toile.diagnosis.masked_blur import blurred_at
from toile.effects.base import BrightnessEffect, Effect
from toile.geometry.mesh import grid_faces, vertex_normals
from toile.limits import Count, Fraction, NonNegative, Positive, Unit
from toile.reconstruction.image_terms.texture_points import grid_points, visible
from toile.reconstruction.problem import Reconstruction

Array = NDArray[np.float64]


@dataclass(frozen=True)
class BrightnessSettings:
    """How brightness on the cloth is read, and how well it is known.

    Attributes:
        patches: along each side of the cloth; brightness is that of a patch.
        per_patch: points along each side of a patch at which colours are read.
        smoothing: σ of the blur before reading [px].
        inside: share of the cloth within the blur around a point, from which on the point counts.
        shown: share of a patch that must be seen for the patch to count.
        noise: deviation of the logarithm of a patch's brightness, whatever the image.
        shared_error: patches that err as one: frames in a row and patches side by side do.
        passes: in which the frames are weighted by what is left of them; it converges within a few.
    """

    patches: Count = 8
    per_patch: Count = 8
    smoothing: Annotated[NonNegative, Unit("px")] = 3.0
    inside: Fraction = 0.9
    shown: Fraction = 0.5
    noise: Positive = 0.02
    shared_error: Positive = 8.0
    passes: Count = 20

    @property
    def lattice(self) -> int:
        """Points along each side of the cloth."""
        return self.patches * self.per_patch


DEFAULT = BrightnessSettings()


@dataclass(frozen=True)
class Brightness:
    """Colours on a lattice over the cloth.

    Attributes:
        brightness: logarithm of patch means relative to frame 0, (F, P) with P patches; 0 where hidden.
        seen: share of each patch that is visible (F, P).
        normals: unit normals of the patches towards the camera (F, P, 3).
    """

    brightness: Array
    seen: Array
    normals: Array


def measured_brightness(
    reconstruction: Reconstruction, positions: Array, settings: BrightnessSettings = DEFAULT
) -> Brightness:
    """Read the colours at tracked positions of the first frames (F, N, 3)."""
    scene = reconstruction.scene
    n, m = settings.lattice, settings.patches
    points = grid_points(scene.grid, n, 0.0, 0)
    at = points.positions(positions)
    pixels = scene.camera.project(torch.from_numpy(at)).numpy()
    shown = visible(reconstruction, points, positions) > 0.5
    normals = vertex_normals(torch.from_numpy(positions), grid_faces(*scene.grid)).numpy()
    normals = points.positions(normals)
    normals *= -np.sign((normals * at).sum(-1, keepdims=True))
    grey = scene.frames[: len(positions)].numpy().mean(-1).astype(np.float64)
    masks = scene.masks[: len(positions)].numpy().astype(np.float64)
    smooth: Array = np.empty(shown.shape)
    for f in range(len(grey)):
        smooth[f], inside = blurred_at(grey[f], masks[f], pixels[f], settings.smoothing)
        shown[f] &= inside > settings.inside
    shown &= shown[:1]
    patch = lambda a: a.reshape(len(a), m, n // m, m, n // m, *a.shape[2:])  # noqa: E731
    weight = patch(shown.astype(np.float64))
    seen = weight.mean((2, 4)).reshape(len(grey), -1)
    # The same points of frame 0: what is hidden now must not count there.
    now = (patch(smooth) * weight).sum((2, 4)).reshape(len(grey), -1)
    first = (patch(np.broadcast_to(smooth[:1], smooth.shape)) * weight).sum((2, 4)).reshape(len(grey), -1)
    brightness = np.where(seen > settings.shown, np.log(np.maximum(now, 1e-3) / np.maximum(first, 1e-3)), 0.0)
    patch_normals = patch(normals).mean((2, 4)).reshape(len(grey), -1, 3)
    patch_normals /= np.maximum(np.linalg.norm(patch_normals, axis=-1, keepdims=True), 1e-9)
    return Brightness(brightness, np.where(seen > settings.shown, seen, 0), patch_normals)


@dataclass(frozen=True)
class BrightnessFit:
    """How well an effect explains the colours.

    Attributes:
        log_evidence: against no effect.
        mean, covariance: of its coefficients in units of their prior deviations.
        explained: share of the squared change that it explains.
        change: root mean square change that there was to explain.
    """

    log_evidence: float
    mean: Array
    covariance: Array
    explained: float
    change: float


def brightness_evidence(
    effect: BrightnessEffect, seen: Brightness, settings: BrightnessSettings = DEFAULT
) -> BrightnessFit:
    """Evidence that light on turning surfaces explains the changes of brightness.

    The light may turn during the clip: besides the effect's own sensitivities there are the same with slow
    changes in time, which a fixed light does not need and the evidence penalises.

    The noise of every frame is its own, that of a sensor and what light does not explain there: where the
    tracking is lost, colours are those of other places, and a few such frames must not decide. It is profiled
    out, and the coefficients by Laplace's approximation at their most probable values.
    """
    scales = effect.scales
    normals = torch.from_numpy(seen.normals)
    reference = normals[:1].expand_as(normals)

    def factor(acting: Effect) -> torch.Tensor:
        assert isinstance(acting, BrightnessEffect)
        return acting.brightness(normals, reference).log()

    fixed: Array = np.moveaxis(derivatives(factor, effect), 0, -1)
    weights = seen.seen / settings.noise**2 / settings.shared_error
    counts = (weights > 0).sum(1) / settings.shared_error
    F = len(normals)
    turning = [fixed]
    for k in (1, 2):
        turning.append(seen.normals * np.sin(0.5 * np.pi * k * np.arange(F) / max(F - 1, 1))[:, None, None])
    y = seen.brightness
    total = (weights * y**2).sum(1)
    best: BrightnessFit | None = None
    for sensitivities in (fixed, np.concatenate(turning, -1)):
        mean = np.zeros(sensitivities.shape[-1])
        rest = total
        for _ in range(settings.passes):
            noise = (counts + rest) / np.maximum(counts, 1e-9)
            weighted = sensitivities * (weights / noise[:, None])[..., None]
            H = np.eye(len(mean)) + np.einsum("fpk,fpl->kl", weighted, sensitivities)
            mean = np.linalg.solve(H, np.einsum("fpk,fp->k", weighted, y))
            rest = (weights * (y - sensitivities @ mean) ** 2).sum(1)
        there = counts > 0
        gain = counts[there] * np.log((counts + total)[there] / (counts + rest)[there])
        value = 0.5 * float(gain.sum() - mean @ mean - np.linalg.slogdet(H)[1]) - float(np.log(2))
        found = BrightnessFit(
            value,
            mean[: len(scales)],
            np.asarray(np.linalg.inv(H)[: len(scales), : len(scales)], np.float64),
            1 - float(rest.sum()) / max(float(total.sum()), 1e-9),
            float(np.sqrt((seen.seen * y**2).sum() / max(seen.seen.sum(), 1e-9))),
        )
        if best is None or found.log_evidence > best.log_evidence:
            best = found
    assert best is not None
    return best
