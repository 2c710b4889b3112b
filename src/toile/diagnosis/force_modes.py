"""Modes of a missing force, parted into those that no law of the material can stand for and the rest.

What the cloth does to itself has neither resultant nor torque, and what its holders do has none about the
line through them. So whatever stretching, bending and damping are really like, the torque of gravity, wind
and inertia about the line through two pinned corners must balance: a part of the missing force that does not
leave that balance alone is external, and the rest may be internal.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

TOLERANCE = 0.05
"""See n_balanced."""


def n_balanced(pinned: Array, size: float, tolerance: float = TOLERANCE) -> int:
    """How many resultants and torques the holders leave alone: 6 without any, 3, 1 for a line, else 0.

    Args:
        pinned: positions of the pinned vertices (n_pinned, 3) [m].
        size: of the cloth [m].
        tolerance: singular value of resultants and torques (over the size) of unit forces at the holders,
            below which a direction counts as free.
    """
    return int(6 - (np.linalg.svd(_reactions(pinned, size), compute_uv=False) > tolerance).sum())


def balanced_directions(pinned: Array, size: float, tolerance: float = TOLERANCE) -> Array:
    """Directions of resultants and torques about the holders' mean that the holders leave alone.

    Args:
        pinned: see n_balanced.
        size: see n_balanced; torques are over it.
        tolerance: see n_balanced.

    Returns:
        (n, 6), orthonormal, over [resultant | torque over the size].
    """
    left, values, _ = np.linalg.svd(_reactions(pinned, size))
    held = int((values > tolerance).sum())
    return np.asarray(left[:, held:].T)


def external_first(fields: Array, masses: Array, positions: Array, pinned: Array, n: int) -> Array:
    """Orthonormal combinations of force modes, the first n of which alone disturb the balance.

    Args:
        fields: forces per mass (K, N, 3), zero at pinned vertices.
        masses: (N,) [kg].
        positions: of the vertices (N, 3) [m].
        pinned: positions of the pinned ones (n_pinned, 3) [m].
        n: from n_balanced.

    Returns:
        (K, K), one combination per row.
    """
    size = float(np.linalg.norm(positions.max(0) - positions.min(0)))
    about = pinned.mean(0) if len(pinned) else positions.mean(0)
    forces = fields * masses[:, None]
    torques = np.cross((positions - about) / size, forces).sum(1)
    wrenches = np.concatenate((forces.sum(1), torques), 1)
    left, _, _ = np.linalg.svd(_reactions(pinned, size))
    disturbed = wrenches @ left[:, 6 - n :]
    combinations, _, _ = np.linalg.svd(disturbed)
    return np.asarray(combinations.T)


def _reactions(pinned: Array, size: float) -> Array:
    """Resultants and torques over the cloth's size (6, 3 n_pinned) of unit forces at the pinned vertices."""
    if not len(pinned):
        return np.zeros((6, 1))
    arms = (pinned - pinned.mean(0)) / size
    eye = np.broadcast_to(np.eye(3), (len(pinned), 3, 3))
    torques = np.cross(arms[:, None], eye)
    return np.asarray(np.concatenate((eye, torques), 2).reshape(-1, 6).T)
