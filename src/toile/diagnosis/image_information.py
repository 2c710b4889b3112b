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
    """(I⁻¹ + σ² 1)⁻¹ of an information I, by the Cholesky factor of 1 + σ² I.

    It is (1 - (1 + σ² I)⁻¹) / σ², which needs no I⁻¹: that is not there where points are hidden. The factor
    takes a third of the time that the matrix itself would, and a product as long as one with that.

    Args:
        factor: lower, of 1 + σ² I, in Fortran's order (n, n); what is above its diagonal is not read.
        variance: σ² [m²].
    """

    def __init__(self, factor: Single, variance: float) -> None:
        self.factor, self.variance = factor, np.float32(variance)
        # Processes that share work have it once.
        factor.flags.writeable = False

    def __matmul__(self, right: NDArray[np.floating]) -> Single:
        """Product with (n,) or (n, R), in single precision."""
        single = np.asarray(right, np.float32)
        if single.ndim == 1:
            half = blas.strsv(self.factor, single, lower=1)
            kept = blas.strsv(self.factor, half, lower=1, trans=1)
        else:
            kept, _ = lapack.spotrs(self.factor, single, lower=1)
        return np.asarray((single - kept) / self.variance, np.float32)

    def toarray(self) -> Single:
        """The matrix itself (n, n) [1/m²]."""
        inverse, wrong = lapack.dpotri(self.factor.astype(np.float64), lower=1)
        assert not wrong
        kept = np.tril(inverse) + np.tril(inverse, -1).T
        return np.asarray((np.eye(len(kept)) - kept) / float(self.variance), np.float32)


Information: TypeAlias = Single | sparse.csr_matrix | SoftenedInformation
"""Of one frame (3N, 3N) [1/m²]: dense, sparse on the scene's own grid, or softened."""


def as_array(information: Information) -> Single:
    """The matrix as an array (n, n) [1/m²]."""
    return np.asarray(information if isinstance(information, np.ndarray) else information.toarray())
