"""Where the effect that is named acts, on the grid of the scene."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import torch

from toile.diagnosis.effect_map import effect_map
from toile.effects.air_drag import AirDrag
from toile.effects.anchor_slip import AnchorSlip
from toile.effects.base import Surroundings
from toile.effects.contact import Contact
from toile.effects.obstacles import Plane
from toile.physics.cloth import grid_cloth

GRAVITY = torch.tensor([0.0, 9.81, 0.0], dtype=torch.float64)
AROUND = Surroundings(grid_cloth((3, 3), (0.2, 0.2), 0.1, (0, 2)), (0.2, 0.2), GRAVITY, 25.0, 3)


def session(motions: list[np.ndarray]) -> tuple[Any, Any]:
    """Clips of a model of 3 × 3 vertices whose scene has 5 × 5, linear between them."""
    at = np.linspace(0, 2, 5)[:, None]
    between = np.clip(1 - np.abs(at - np.arange(3)), 0, None)
    grid = SimpleNamespace(prolong=np.kron(between, between))
    seen = SimpleNamespace(problem=SimpleNamespace(scene=SimpleNamespace(grid=(5, 5))))
    clip = SimpleNamespace(shooting=SimpleNamespace(substeps=1), around=AROUND)
    n = len(motions)
    model = SimpleNamespace(fitting=SimpleNamespace(clips=[clip] * n), clips=[seen] * n, grids=[grid] * n)
    windows = [[SimpleNamespace(positions=x)] for x in motions]
    return model, SimpleNamespace(windows=windows)


def still(depth: float) -> np.ndarray:
    i, j = np.meshgrid(np.arange(3), np.arange(3), indexing="ij")
    x = np.stack((0.1 * j, 0.1 * i, np.full((3, 3), depth)), -1).reshape(1, 9, 3)
    return np.repeat(x, 3, 0)


def test_a_corner_that_slips() -> None:
    found = effect_map(*session([still(1.0)]), [AnchorSlip(vertex=1)])
    assert found is not None
    assert found.shape == (5, 5)
    assert np.unravel_index(found.argmax(), found.shape) == (0, 4)
    assert found.max() == 1.0
    assert found[4, 0] == 0.0


def test_a_corner_that_slips_in_one_clip() -> None:
    """In the other one the corner of that number is another, and none of its own slips."""
    clips = [still(1.0), still(1.0)]
    alone = effect_map(*session([still(1.0)]), [AnchorSlip(vertex=1)])
    found = effect_map(*session(clips), [None, AnchorSlip(vertex=1)])
    assert found is not None
    np.testing.assert_array_equal(found, alone)


def test_what_touches_in_any_clip_counts() -> None:
    """In the first clip the right column enters, in the second one, half as deep, the lowest row."""
    right = Contact(Plane((0.2, 0.0, 0.0), (-1.0, 0.0, 0.0)), thickness=0.02)
    below = Contact(Plane((0.0, 0.21, 0.0), (0.0, -1.0, 0.0)), thickness=0.02)
    found = effect_map(*session([still(1.0), still(1.0)]), [right, below])
    assert found is not None
    np.testing.assert_allclose(found[0], [0, 0, 0, 1 / 3, 2 / 3], atol=1e-9)
    np.testing.assert_allclose(found[4], [1 / 3, 1 / 3, 1 / 3, 2 / 3, 1], atol=1e-9)


def test_what_acts_everywhere_or_nowhere_has_no_map() -> None:
    assert effect_map(*session([still(1.0)]), [AirDrag()]) is None
    assert effect_map(*session([still(1.0)]), [Contact()]) is None
