"""The pose of a flat rectangle of known size from the pixels of its four corners."""

from __future__ import annotations

import numpy as np

from toile.geometry.surface import Floats


def rectangle_grid(size: tuple[float, float], shape: tuple[int, int]) -> Floats:
    """Grid (H, W, 3) [m] of a flat rectangle around the origin: axis 0 along x, axis 1 along y, z = 0."""
    x = np.linspace(-size[0] / 2, size[0] / 2, shape[0])
    y = np.linspace(-size[1] / 2, size[1] / 2, shape[1])
    return np.stack(np.broadcast_arrays(x[:, None], y[None, :], 0.0), -1)


def rectangle_pose(size: tuple[float, float], corners: Floats, K: Floats) -> tuple[Floats, Floats, float]:
    """Rotation (3, 3) and translation (3,) [m] that put a rectangle where its corners are seen.

    Least squares of the distances in the image (OpenCV), from both poses that explain a plane seen from afar
    almost equally well (Collins and Bartoli, Infinitesimal Plane-Based Pose Estimation, IJCV 109, 2014).

    Args:
        size: sides [m] along x and y of the rectangle.
        corners: (4, 2) [px] in the order upper left, upper right, lower right, lower left, which are the
            corners (-, -), (+, -), (+, +), (-, +) of the rectangle.
        K: intrinsic matrix.

    Returns:
        Rotation, translation, and the root mean square distance of the corners [px].
    """
    import cv2

    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    model = np.column_stack((signs * np.array(size) / 2, np.zeros(4)))
    until = cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 100, 1e-12
    _, rotations, translations, _ = cv2.solvePnPGeneric(model, corners, K, None, flags=cv2.SOLVEPNP_IPPE)
    fits = []
    for start in zip(rotations, translations, strict=True):
        pose = cv2.solvePnPRefineLM(model, corners, K, None, *start, until)
        seen, _ = cv2.projectPoints(model, *pose, K, None)
        fits.append((float(np.sqrt(((seen[:, 0] - corners) ** 2).sum(1).mean())), pose))
    error, (rotation, translation) = min(fits, key=lambda fit: fit[0])
    turned, _ = cv2.Rodrigues(rotation)
    return np.asarray(turned, np.float64), np.asarray(translation[:, 0], np.float64), error
