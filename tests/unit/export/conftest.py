from __future__ import annotations

import numpy as np
import pytest

from toile.export.animation import ClothAnimation


@pytest.fixture
def animation() -> ClothAnimation:
    """Three frames of a 3×4 grid whose vertices are all different, so that any reordering shows."""
    rng = np.random.default_rng(0)
    v, u = np.meshgrid(np.linspace(0, 1, 3), np.linspace(0, 1, 4), indexing="ij")
    texture = rng.uniform(size=(5, 6, 3))
    return ClothAnimation(
        positions=np.stack((u, v, np.ones_like(u)), -1) + 0.05 * rng.normal(size=(3, 3, 4, 3)),
        fps=25.0,
        texture_coordinates=np.stack((u, v), -1),
        texture=texture,
    )
