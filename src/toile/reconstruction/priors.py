"""Gaussian smoothness priors, diagonal in a cosine basis.

The force regularisation of the paper (Eq. 17) is a quadratic form in T: its length, its change in time and
its change along the two grid directions. With free ends that form is diagonal in the cosine transform,

    R_T = ½ Σ_k |T̂_k|² / q_k²,   q_k = σ' (1 + l_t² λ_t + l_s² (λ_i + λ_j))^{-½},   λ = 2 - 2 cos(π k / n),

so T = DCT⁻¹(q z) turns it into ½ |z|²: standardised coordinates z in which Gauss-Newton is well conditioned.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import fft

Array = NDArray[np.float64]


def _laplacian_eigenvalues(n: int) -> Array:
    return 2 - 2 * np.cos(np.pi * np.arange(n) / n)


class SmoothField:
    """Prior of a vector field over time and a grid, (n, H, W, 3).

    Args:
        shape: (n, H, W).
        deviation: standard deviation of each component, averaged over the field; its unit is the field's.
        time_scale: l_t, frames over which the field is correlated.
        space_scale: l_s, vertices over which the field is correlated.
    """

    def __init__(
        self, shape: tuple[int, int, int], deviation: float, time_scale: float, space_scale: float
    ) -> None:
        n, height, width = shape
        rough = (
            1
            + time_scale**2 * _laplacian_eigenvalues(n)[:, None, None]
            + space_scale**2
            * (_laplacian_eigenvalues(height)[None, :, None] + _laplacian_eigenvalues(width)[None, None, :])
        )
        q = rough**-0.5
        self._q = (q * (deviation / np.sqrt((q**2).mean())))[..., None]

    def restored(self, standardised: Array) -> Array:
        """Standardised coordinates to the field."""
        return np.asarray(fft.idctn(self._q * standardised, axes=(0, 1, 2), norm="ortho"))

    def restored_adjoint(self, gradient: Array) -> Array:
        """Gradient with respect to the field to one with respect to the standardised coordinates."""
        return np.asarray(self._q * fft.dctn(gradient, axes=(0, 1, 2), norm="ortho"))

    def standardise(self, field: Array) -> Array:
        """Inverse of colour."""
        return np.asarray(fft.dctn(field, axes=(0, 1, 2), norm="ortho") / self._q)


class SmoothSeries:
    """Prior of a time series of vectors, (n, m, 3): boundary motion.

    Args:
        n: number of frames.
        deviation: standard deviation of each component.
        time_scale: frames over which the series is correlated.
    """

    def __init__(self, n: int, deviation: float, time_scale: float) -> None:
        q = 1 / (1 + time_scale**2 * _laplacian_eigenvalues(n))
        self._q = (q * (deviation / np.sqrt((q**2).mean())))[:, None, None]

    def restored(self, standardised: Array) -> Array:
        """Standardised coordinates to the series."""
        return np.asarray(fft.idct(self._q * standardised, axis=0, norm="ortho"))

    def restored_adjoint(self, gradient: Array) -> Array:
        """Gradient with respect to the series to one with respect to the standardised coordinates."""
        return np.asarray(self._q * fft.dct(gradient, axis=0, norm="ortho"))

    def standardise(self, series: Array) -> Array:
        """Inverse of colour."""
        return np.asarray(fft.dct(series, axis=0, norm="ortho") / self._q)
