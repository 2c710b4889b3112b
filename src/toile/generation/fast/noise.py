"""Errors of tracked positions, until residuals of real tracking take their place."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

Array = NDArray[np.float64]


def tracking_noise(
    rng: np.random.Generator, shape: tuple[int, int, int], fps: float, deviation: float
) -> Array:
    """Smooth and white errors that begin at 0, since the template is known.

    Args:
        rng: for everything random, kind and proportions included.
        shape: (F, H, W).
        fps: frames per second.
        deviation: root of the mean square over vertices and frames of the length of the error [m].

    Returns:
        Errors (F, H, W, 3) [m].
    """
    F, H, W = shape
    n_modes = 6
    u = (np.arange(H) + 0.5) / H
    v = (np.arange(W) + 0.5) / W
    k = np.arange(n_modes)
    rows, columns = np.cos(np.pi * u[:, None] * k), np.cos(np.pi * v[:, None] * k)
    falling = (1 + k[:, None] + k[None]) ** -float(rng.uniform(0.3, 1.5))
    correlation = float(np.exp(rng.uniform(np.log(0.02), np.log(0.5))))  # s
    weights = gaussian_filter1d(rng.standard_normal((F, n_modes, n_modes, 3)), correlation * fps, axis=0)
    smooth = np.einsum("hi,wj,ij,fijc->fhwc", rows, columns, falling, weights, optimize=True)
    white = rng.standard_normal((F, H, W, 3))
    share = float(rng.uniform(0.05, 0.6))
    error = (1 - share) * smooth / _rms(smooth) + share * white / _rms(white)
    # A camera sees depth worst: one direction, at some angle to the cloth, is noisier than the others.
    depth = rng.standard_normal(3) * (0.4, 0.2, 1.0)
    depth /= np.linalg.norm(depth)
    error += (float(rng.uniform(1, 4)) - 1) * (error @ depth)[..., None] * depth
    frames = np.arange(F) / fps
    error *= np.minimum(frames / float(rng.uniform(0.05, 0.4)), 1)[:, None, None, None]
    result: Array = deviation * error / _rms(error)
    return result


def _rms(error: Array) -> float:
    """Root of the mean square of the length of vectors (..., 3)."""
    return float(np.sqrt((error**2).sum(-1).mean()))
