"""Predictions are judged by the images, not by a motion that the base model has refined."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import sparse

from toile.diagnosis.image_error import ImageError
from toile.diagnosis.tracked import Tracked

N = 9


def tracked(seen: np.ndarray, off: np.ndarray) -> Tracked:
    """Images that have the cloth ``off`` (N, 3) from the tracked positions, and see (3,) along three axes."""
    positions = np.random.default_rng(3).standard_normal((1, N, 3))
    matrix = np.diag(np.tile(seen, N)).astype(np.float32)
    slope = -(matrix @ off.reshape(-1)).reshape(1, N, 3)
    return Tracked(positions, [matrix], slope, positions)


def test_positions_are_measured_from_where_the_images_have_the_cloth() -> None:
    off = np.tile([0.004, 0.0, 0.0], (N, 1))
    motion = tracked(np.full(3, 1e6), off)
    error = ImageError(motion)
    truth = motion.positions[0] + off
    assert error.of(0, truth) == pytest.approx(0.0, abs=1e-4)
    assert error.of(0, motion.positions[0]) == pytest.approx(0.004, rel=0.02)
    assert error.of(0, truth + np.array([0.0, 0.003, 0.0])) == pytest.approx(0.003, rel=0.02)


def test_a_direction_that_images_do_not_see_does_not_count() -> None:
    motion = tracked(np.array([1e6, 1e6, 1.0]), np.zeros((N, 3)))
    error = ImageError(motion)
    assert error.of(0, motion.positions[0] + np.array([0.0, 0.0, 0.05])) < 1e-3
    # What is not seen stays as tracked, however steep the term is there.
    steep = replace(motion, gradient=np.tile([0.0, 0.0, 1.0], (1, N, 1)))
    assert np.allclose(ImageError(steep).favoured(0), motion.positions[0], atol=1e-3)


def test_sparse_images_say_the_same() -> None:
    off = np.random.default_rng(4).standard_normal((N, 3)) * 0.002
    dense = tracked(np.array([1e6, 1e6, 2e4]), off)
    thin = replace(dense, information=[sparse.csr_matrix(dense.information[0])])
    x = dense.positions[0] + 0.01
    assert ImageError(thin).of(0, x) == pytest.approx(ImageError(dense).of(0, x), rel=1e-6)
