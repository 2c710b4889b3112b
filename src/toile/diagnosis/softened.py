"""Tracked motion with the error of the model added to that of the images.

Images may say where the cloth is to a tenth of a millimetre; a model on a coarse grid does not go there, and
what it is wrong by is smooth in space and time. Without that error in the likelihood every hypothesis is
wrong by thousands of nats, and the one that bends to the model's error wins (Kennedy and O'Hagan 2001).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import lapack

from toile.diagnosis.tracked import Tracked
from toile.limits import Count, Positive, Unit

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ModelError:
    """What a right hypothesis is still wrong by.

    Attributes:
        share: root mean square error over the cloth's width.
        modes: of a frame that err independently, along each of three axes.
        frames: over which errors last, at 25 frames a second.
    """

    share: Annotated[Positive, Unit("widths")] = 0.0025
    modes: Count = 16
    frames: Positive = 1.35


DEFAULT = ModelError()


def softened(
    tracked: Tracked, width: float, fps: float, likelihood_weight: float, error: ModelError = DEFAULT
) -> Tracked:
    """The same motion, no surer than the model can be right.

    Args:
        tracked: what the images say.
        width: of the cloth [m].
        fps: frames per second.
        likelihood_weight: of the images' information, see ShootingSettings; it is in the result, whose own
            weight is 1.
        error: of the model.
    """
    n = tracked.positions.shape[1]
    lasting = error.frames * max(fps / 25, 1.0)
    # Of every vertex, so that smooth modes have the variance that is asked for.
    variance = (error.share * width) ** 2 * n / error.modes * lasting
    information, gradient = [], np.empty_like(tracked.positions)
    eye = np.eye(3 * n)
    for frame, matrix in enumerate(tracked.information):
        dense = matrix.toarray() if isinstance(matrix, sparse.csr_matrix) else np.asarray(matrix)
        image = likelihood_weight * dense.astype(np.float64)
        # (I⁻¹ + σ² 1)⁻¹ without I⁻¹, which is not there where points are hidden; (1 - (1 + σ² I)⁻¹) / σ².
        kept = _inverse(eye + 0.5 * variance * (image + image.T))
        information.append(((eye - kept) / variance).astype(np.float32))
        slope = likelihood_weight * tracked.gradient[frame].reshape(-1)
        gradient[frame] = (kept @ slope).reshape(n, 3)
    return Tracked(tracked.positions, information, gradient, tracked.fine_positions)


def _inverse(matrix: Array) -> Array:
    """Of a symmetric positive-definite matrix, by its factor: half the work of solving for an identity.

    Raises:
        FloatingPointError: it is not positive definite.
    """
    # In Fortran's order it is the same matrix.
    factor, wrong = lapack.dpotrf(matrix.T, lower=1, overwrite_a=1)
    if not wrong:
        lower, wrong = lapack.dpotri(factor, lower=1, overwrite_c=1)
    if wrong:
        raise FloatingPointError("the images' information is not positive definite")
    lower = np.tril(lower)
    return np.asarray(lower + np.tril(lower, -1).T)
