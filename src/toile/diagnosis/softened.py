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
from scipy.linalg import lapack

from toile.diagnosis.image_information import SoftenedInformation, as_array
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

    def lasting(self, fps: float) -> float:
        """Frames over which errors last at so many frames per second."""
        return self.frames * max(fps / 25, 1.0)


DEFAULT = ModelError()


def softened(
    tracked: Tracked,
    width: float,
    fps: float,
    likelihood_weight: float,
    error: ModelError = DEFAULT,
    uneven: Array | None = None,
) -> Tracked:
    """The same motion, no surer than the model can be right.

    Args:
        tracked: what the images say.
        width: of the cloth [m].
        fps: frames per second.
        likelihood_weight: of the images' information, see ShootingSettings; it is in the result, whose own
            weight is 1.
        error: of the model.
        uneven: variance of its errors at every vertex over the mean (N,); None: alike everywhere.
    """
    n = tracked.positions.shape[1]
    lasting = error.lasting(fps)
    # Of every vertex, so that smooth modes have the variance that is asked for.
    variance = (error.share * width) ** 2 * n / error.modes * lasting
    information, gradient = [], np.empty_like(tracked.positions)
    # Memory that is used again: to ask for as much anew in every frame takes longer than what is done in it.
    scaled = np.empty((3 * n, 3 * n))
    relative = None if uneven is None else np.repeat(np.sqrt(uneven), 3)
    single = None if relative is None else relative.astype(np.float32)
    for frame, matrix in enumerate(tracked.information):
        np.multiply(as_array(matrix), variance * likelihood_weight, out=scaled, dtype=np.float64)
        slope = likelihood_weight * tracked.gradient[frame].reshape(-1)
        if relative is not None:
            scaled *= relative[:, None]
            scaled *= relative
            slope = slope * relative
        scaled[np.diag_indices(3 * n)] += 1.0
        # In Fortran's order it is the same matrix.
        factor, wrong = lapack.dpotrf(scaled.T, lower=1, clean=0, overwrite_a=1)
        if wrong:
            raise FloatingPointError("the images' information is not positive definite")
        slope, _ = lapack.dpotrs(factor, slope, lower=1)
        gradient[frame] = (slope if relative is None else slope / relative).reshape(n, 3)
        information.append(SoftenedInformation(factor.astype(np.float32), variance, single))
    return Tracked(tracked.positions, information, gradient, tracked.fine_positions)
