"""How sure images are of a frame: Gauss-Newton matrices of the image term, as they come or softened."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import blas, lapack

Array = NDArray[np.float64]
Single = NDArray[np.float32]


class SoftenedInformation:
    """(I⁻¹ + σ² R²)⁻¹ of an information I and a diagonal R, by the Cholesky factor of 1 + σ² R I R.

    It is R⁻¹ (1 - (1 + σ² R I R)⁻¹) R⁻¹ / σ², which needs no I⁻¹: that is not there where points are hidden.
    The factor takes a third of the time that the matrix itself would, and a product as long as one with that.

    Args:
        factor: lower, of 1 + σ² R I R, in Fortran's order (n, n); what is above its diagonal is not read.
        variance: σ² [m²].
        relative: the diagonal of R (n,); None for 1.
    """

    def __init__(self, factor: Single, variance: float, relative: Single | None = None) -> None:
        self.factor, self.variance, self.relative = factor, np.float32(variance), relative
        # Processes that share work have it once.
        factor.flags.writeable = False

    def __matmul__(self, right: NDArray[np.floating]) -> Single:
        """Product with (n,) or (n, R), in single precision."""
        single = self._over_relative(np.asarray(right, np.float32))
        if single.ndim == 1:
            half = blas.strsv(self.factor, single, lower=1)
            kept = blas.strsv(self.factor, half, lower=1, trans=1)
        else:
            kept, _ = lapack.spotrs(self.factor, single, lower=1)
        return self._over_relative(np.asarray((single - kept) / self.variance, np.float32))

    def quadratic(self, motion: Single) -> Single:
        """motionᵀ self motion (R, R) for motions (n, R): half of what the product would take."""
        changed = self._over_relative(motion)
        # (F⁻¹ changed)ᵀ, of the transpose, so that neither is copied into another order.
        kept = blas.strsm(1.0, self.factor, changed.T, side=1, lower=1, trans_a=1)
        return np.asarray((changed.T @ changed - kept @ kept.T) / self.variance)

    def toarray(self) -> Single:
        """The matrix itself (n, n) [1/m²]."""
        inverse = self._inverse()
        kept = np.tril(inverse) + np.tril(inverse, -1).T
        matrix = (np.eye(len(kept)) - kept) / float(self.variance)
        return self._over_relative(self._over_relative(np.asarray(matrix, np.float32)).T)

    def variances(self) -> Array:
        """The diagonal of σ² R² (n,) [m²]."""
        relative = np.ones(len(self.factor)) if self.relative is None else self.relative.astype(np.float64)
        return float(self.variance) * relative**2

    def known(self) -> Array:
        """Of every coordinate, the share of its variance that the information resolves (n,), 0 to 1."""
        return 1 - np.diag(self._inverse())

    def _inverse(self) -> Array:
        """Of the matrix that is factored; its lower triangle."""
        inverse, wrong = lapack.dpotri(self.factor.astype(np.float64), lower=1)
        assert not wrong
        return inverse

    def _over_relative(self, single: Single) -> Single:
        """R⁻¹ times (n,) or (n, R)."""
        if self.relative is None:
            return single
        return single / (self.relative if single.ndim == 1 else self.relative[:, None])


Information: TypeAlias = Single | sparse.csr_matrix | SoftenedInformation
"""Of one frame (3N, 3N) [1/m²]: dense, sparse on the scene's own grid, or softened."""


def quadratic(information: Information, motion: Single) -> Single:
    """motionᵀ information motion (R, R) for motions (n, R)."""
    if isinstance(information, SoftenedInformation):
        return information.quadratic(motion)
    return np.asarray(motion.T @ (information @ motion))


def as_array(information: Information) -> Single:
    """The matrix as an array (n, n) [1/m²]."""
    return np.asarray(information if isinstance(information, np.ndarray) else information.toarray())
