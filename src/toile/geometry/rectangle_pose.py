"""The pose of a flat rectangle of known size from the pixels of its four corners."""

from __future__ import annotations

import numpy as np

from toile.geometry.surface import Floats

_TILTS = (-0.6, 0.0, 0.6)  # rad; a plane seen from afar has two poses that explain it almost equally well


def rectangle_grid(size: tuple[float, float], shape: tuple[int, int]) -> Floats:
    """Grid (H, W, 3) [m] of a flat rectangle around the origin: axis 0 along x, axis 1 along y, z = 0."""
    x = np.linspace(-size[0] / 2, size[0] / 2, shape[0])
    y = np.linspace(-size[1] / 2, size[1] / 2, shape[1])
    return np.stack(np.broadcast_arrays(x[:, None], y[None, :], 0.0), -1)


def rectangle_pose(size: tuple[float, float], corners: Floats, K: Floats) -> tuple[Floats, Floats, float]:
    """Rotation (3, 3) and translation (3,) [m] that put a rectangle where its corners are seen.

    Least squares of the distances in the image, from several starts.

    Args:
        size: sides [m] along x and y of the rectangle.
        corners: (4, 2) [px] in the order upper left, upper right, lower right, lower left, which are the
            corners (-, -), (+, -), (+, +), (-, +) of the rectangle.
        K: intrinsic matrix.

    Returns:
        Rotation, translation, and the root mean square distance of the corners [px].
    """
    from scipy.optimize import least_squares
    from scipy.spatial.transform import Rotation

    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    model = np.column_stack((signs * np.array(size) / 2, np.zeros(4)))

    def offsets(pose: Floats) -> Floats:
        seen = (Rotation.from_rotvec(pose[:3]).apply(model) + pose[3:]) @ K.T
        # A start may swing through the camera's plane.
        difference: Floats = seen[:, :2] / np.maximum(seen[:, 2:], 1e-3) - corners
        return difference.ravel()

    spans = np.linalg.norm(corners - np.roll(corners, -1, 0), axis=1)
    depth = float(np.mean([K[0, 0] * size[0] / spans[0::2].mean(), K[1, 1] * size[1] / spans[1::2].mean()]))
    centre = depth * np.linalg.solve(K, np.append(corners.mean(0), 1.0))
    starts = [np.r_[a, b, 0.0, centre] for a in _TILTS for b in _TILTS]
    fits = [least_squares(offsets, start, x_scale=np.r_[np.ones(3), np.full(3, depth)]) for start in starts]
    best = min((fit for fit in fits if fit.x[5] > 0), key=lambda fit: fit.cost, default=fits[0])
    error = float(np.sqrt(2 * best.cost / 4))
    return Rotation.from_rotvec(best.x[:3]).as_matrix(), best.x[3:], error
