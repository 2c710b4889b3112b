"""How wrong the base model is on the clips in hand: what it leaves, against what was expected of it.

How precisely a model on a grid follows a cloth differs by a factor of ten between cloths. With errors
thought too large, images say hardly anything; thought too small, whatever bends to them wins. So their size
is found on the clips (Kennedy and O'Hagan 2001), under the base model, for all hypotheses alike.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from toile.diagnosis.joint_fit import frame_positions
from toile.diagnosis.shooting import Shooting, WindowMotion, cosine_modes
from toile.diagnosis.softened import ModelError

Array = NDArray[np.float64]

SMALLEST, LARGEST = 0.0005, 0.01
"""Errors that are thought possible [widths]."""

_RIDGE = 1e-6
"""Of what is known about smooth errors, where images see nothing."""


@dataclass(frozen=True)
class ModelErrors:
    """Smooth errors of a model.

    Attributes:
        cost: of those that it makes: how much less the images would cost without them [nats].
        expected: the same for errors of the size that was thought.
        share: that size, root mean square over the cloth's width.
    """

    cost: float
    expected: float
    share: float

    @property
    def found(self) -> float:
        """The share with which cost and expectation would be nearer to each other."""
        factor = float(np.sqrt(max(self.cost, 0.0) / max(self.expected, 1e-9)))
        return float(np.clip(self.share * factor, SMALLEST, LARGEST))

    @staticmethod
    def of_all(clips: Iterable[ModelErrors]) -> ModelErrors:
        """Of several clips that have one size."""
        each = list(clips)
        return ModelErrors(sum(e.cost for e in each), sum(e.expected for e in each), each[0].share)


def model_errors(
    shooting: Shooting,
    windows: list[WindowMotion],
    width: float,
    error: ModelError,
    uneven: Array | None = None,
) -> ModelErrors:
    """Of the windows of one clip.

    Args:
        shooting: the problem; its images are softened by ``error``.
        windows: simulated, one after the other.
        width: of the cloth [m].
        error: as it is thought to be.
        uneven: see softened.
    """
    n = max(1, round(error.modes**0.5))
    modes = cosine_modes(shooting.simulator.cloth.lines, n)
    fields = (modes[:, None, :, None] * np.eye(3)[None, :, None, :]).reshape(3 * len(modes), -1)
    frames = frame_positions(shooting, windows)
    covariance = _covariance(shooting, modes, uneven)
    variance = (error.share * width) ** 2 / error.modes
    cost = expected = 0.0
    for f, x in enumerate(frames):
        information = shooting.tracked.information[f]
        known = shooting.weight * np.asarray(fields @ (information @ fields.T), np.float64)
        slope = shooting.weight * (fields @ shooting.tracked.slope(f, x))
        expected += 0.5 * variance * float((known * covariance).sum())
        ridge = _RIDGE * float(np.trace(known)) / len(known) + 1e-12
        cost += 0.5 * float(slope @ cho_solve(cho_factor(known + ridge * np.eye(len(known))), slope))
    return ModelErrors(cost, expected, error.share)


def _covariance(shooting: Shooting, modes: Array, uneven: Array | None) -> Array:
    """Of the smooth errors' coefficients along all axes, those of even errors being 1."""
    if uneven is None:
        return np.eye(3 * len(modes))
    return np.asarray(np.kron((modes * (uneven * mass_shares(shooting))) @ modes.T, np.eye(3)))


def mass_shares(shooting: Shooting) -> Array:
    """Share of the cloth that every vertex stands for (N,)."""
    masses = shooting.simulator.cloth.masses.numpy().astype(np.float64)
    return np.asarray(masses / masses.sum())


def with_share(error: ModelError, share: float | None) -> ModelError:
    """The same errors of another size; None leaves it."""
    return error if share is None else replace(error, share=share)
