"""Where a model of the cloth is wrong: the variance of its errors, place by place.

A limp border that curls, or a fold finer than the grid, is where the base model is wrong by ten times what it
is wrong by elsewhere. With errors thought alike everywhere, whatever bends that one place towards the images
gains there, and what the rest of the cloth says of an effect counts for too little.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from toile.diagnosis.image_information import SoftenedInformation
from toile.diagnosis.joint_fit import frame_positions
from toile.diagnosis.model_errors import mass_shares
from toile.diagnosis.shooting import Shooting, WindowMotion

Array = NDArray[np.float64]

_AVERAGE = 0.1
"""Of what is known of a place: counts as being no more uneven than the average, where images see little."""


def uneven_errors(
    shooting: Shooting, windows: Sequence[WindowMotion], lasting: float, before: Array | None = None
) -> Array:
    """Variance of the errors of every vertex over the mean of the cloth (N,), alike in all frames.

    With errors of covariance D and images of information I, what a motion is off by costs images softened to
    W = (I⁻¹ + D)⁻¹, of slope u. Of what it is off by, D u is the model's (its mean, given the images), whose
    covariance is D W D if D is right. So D is multiplied, place by place, by the squares that are found over
    those that are expected: a fixed-point form of the steps of expectation and maximisation (Dempster, Laird
    and Rubin 1977). A place is as wide as a cell of an even grid of as many vertices.

    Args:
        shooting: the problem; its images are softened.
        windows: simulated, one after the other.
        lasting: frames over which errors last; those between say the same and are left out.
        before: as they are thought to be in ``shooting``; None: alike everywhere.
    """
    frames = frame_positions(shooting, windows)
    n = frames.shape[1]
    found, expected = np.zeros(n), np.zeros(n)
    for f in range(0, len(frames), max(1, round(lasting))):
        information = shooting.tracked.information[f]
        assert isinstance(information, SoftenedInformation)
        squares = information.variances() * shooting.tracked.slope(f, frames[f]) ** 2
        found += squares.reshape(n, 3).sum(-1)
        expected += information.known().reshape(n, 3).sum(-1)
    around = _around(shooting)
    average, seen = found.sum() / expected.sum(), around @ expected
    times = (around @ found + _AVERAGE * average * seen) / ((1 + _AVERAGE) * seen)
    new = (1.0 if before is None else before) * times
    return np.asarray(new / (mass_shares(shooting) @ new))


def _around(shooting: Shooting) -> Array:
    """How much of a vertex's place every vertex is in (N, N)."""
    along = []
    for at in shooting.simulator.cloth.lines.places():
        places = at.numpy().astype(np.float64)
        away = (places[:, None] - places) * (len(places) - 1)
        along.append(np.exp(-0.5 * away**2))
    return np.asarray(np.kron(*along))
