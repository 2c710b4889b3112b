"""Forces that hang on the motion before a step: all of their derivative, from few adjoints."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from toile.diagnosis.past_forces import PastForces
from toile.effects.base import ElementEffect, Surroundings, VertexEffect
from toile.effects.catalogue import CATALOGUE
from toile.effects.contact import Contact
from toile.effects.obstacles import Plane
from toile.effects.setting import setting
from toile.physics.cloth import grid_cloth, grid_material
from toile.physics.implicit.terms import term_forces
from toile.physics.step_terms import StepContext

GRID = (7, 8)
WITH_PAST = [n for n, kind in CATALOGUE.items() if issubclass(kind, VertexEffect | ElementEffect)]


OWN_PAST = [n for n in WITH_PAST if getattr(CATALOGUE[n], "own_past", False)]


@pytest.mark.parametrize(
    ("name", "own_past"), [(n, n in OWN_PAST) for n in WITH_PAST] + [(n, False) for n in OWN_PAST]
)
def test_few_adjoints_give_the_whole_derivative(
    name: str, own_past: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Element by element where the past of an element is its own, and vertex by vertex."""
    if name in OWN_PAST:
        monkeypatch.setattr(CATALOGUE[name], "own_past", own_past)
    cloth = grid_cloth(GRID, (0.3, 0.35), 0.15, (0, GRID[1] - 1))
    rng = np.random.default_rng(3)
    i, j = np.meshgrid(np.arange(GRID[0]), np.arange(GRID[1]), indexing="ij")
    flat = np.stack((0.05 * i, 0.05 * j, 1 + 0.01 * np.sin(i + 0.7 * j)), -1).reshape(-1, 3)
    before = torch.from_numpy(flat + 0.003 * rng.standard_normal(flat.shape))
    after = torch.from_numpy(flat + 0.003 * rng.standard_normal(flat.shape))
    kind = CATALOGUE[name]
    plane = Plane((0.0, 0.0, 1.005), (0.1, 0.2, -1.0))
    effect = Contact(plane, thickness=0.02) if kind is Contact else kind()
    effect = effect.with_values(0.5 * effect.scales)
    gravity = torch.tensor([0.0, 9.81, 0.0], dtype=torch.float64)
    around = Surroundings(cloth, (0.3, 0.35), gravity, 25.0, 5)
    terms = setting((effect,), around, before[cloth.pinned].expand(5, -1, -1), torch.zeros(3).double()).terms
    one = torch.ones(1, dtype=torch.float64)
    speed = torch.from_numpy(rng.standard_normal(flat.shape))
    material = grid_material(400.0 * one, 2e-3 * one, 1e-4 * one)
    now = StepContext(cloth, material, before, speed, 0.1, 0.01, before[cloth.pinned])
    past = PastForces(terms, cloth)
    moved = rng.standard_normal((before.numel(), 4)).astype(np.float32)
    faster = rng.standard_normal((before.numel(), 4)).astype(np.float32)
    found = past.change(now, after.numpy(), moved, faster)

    def forces(x: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
        context = StepContext(cloth, material, x, v, 0.1, 0.01, before[cloth.pinned])
        return term_forces(terms, context, after).reshape(-1)

    by_position, by_speed = torch.autograd.functional.jacobian(forces, (before, speed))
    n = before.numel()
    expected = by_position.reshape(n, n).numpy() @ moved + by_speed.reshape(n, n).numpy() @ faster
    assert np.allclose(found, expected, rtol=1e-4, atol=1e-4 * max(np.abs(expected).max(), 1e-6))


def test_what_shows_nothing_in_one_step_is_asked_again() -> None:
    """A stiffening grows with the square of the strain: none of the past shows where nothing is strained."""
    cloth = grid_cloth(GRID, (6 / 16, 7 / 16), 0.15, (0, GRID[1] - 1))  # lengths without rounding
    i, j = np.meshgrid(np.arange(GRID[0]), np.arange(GRID[1]), indexing="ij")
    flat = torch.from_numpy(np.stack((i / 16, j / 16, np.ones(GRID)), -1).reshape(-1, 3))
    stiffening = CATALOGUE["strain_stiffening"]()
    past = PastForces((stiffening.with_values(stiffening.scales),), cloth)
    one = torch.ones(1, dtype=torch.float64)
    material = grid_material(400.0 * one, 2e-3 * one, 1e-4 * one)
    moved = np.random.default_rng(1).standard_normal((flat.numel(), 2)).astype(np.float32)
    sizes = []
    for strained in (1.0, 1.02):
        x = strained * flat
        now = StepContext(cloth, material, x, 0 * x, 0.1, 0.01, x[cloth.pinned])
        sizes.append(float(np.abs(past.change(now, (1.02 * flat).numpy(), moved, 0 * moved)).max()))
        assert past.remember
    assert sizes[0] <= 1e-9 * sizes[1]
