"""Forces that hang on the motion before a step: all of their derivative, from few adjoints."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain

import numpy as np
import pytest
import torch

from toile.diagnosis.past_forces import PastForces, PastOfStep
from toile.diagnosis.template_tension import TemplateTension
from toile.effects.base import ElementEffect, Surroundings, VertexEffect
from toile.effects.catalogue import CATALOGUE
from toile.effects.contact import Contact
from toile.effects.internal_damping import InternalDamping
from toile.effects.obstacles import Plane
from toile.effects.setting import setting
from toile.physics.cloth import Cloth, grid_cloth, grid_material
from toile.physics.elements import Elements
from toile.physics.implicit.terms import term_forces
from toile.physics.step_terms import StepContext, StepTerm

GRID = (7, 8)
ONE = torch.ones(1, dtype=torch.float64)
MATERIAL = grid_material(400.0 * ONE, 2e-3 * ONE, 1e-4 * ONE)
WITH_PAST = [n for n, kind in CATALOGUE.items() if issubclass(kind, VertexEffect | ElementEffect)]


OWN_PAST = [n for n in WITH_PAST if getattr(CATALOGUE[n], "own_past", False)]


OWN_PAST = [n for n in WITH_PAST if CATALOGUE[n].own_past]
"""Asked in both ways: by themselves, and by adjoints of vertices that do not meet."""


def one_step(past: PastForces, now: StepContext, positions: np.ndarray) -> PastOfStep:
    return past.of_steps([(now, positions)])[0]


def cloth_of_grid() -> Cloth:
    return grid_cloth(GRID, (0.3, 0.35), 0.15, (0, GRID[1] - 1))


def terms_of(name: str, cloth: Cloth, boundary: torch.Tensor) -> Sequence[StepTerm]:
    """An effect of half its usual strength."""
    kind = CATALOGUE[name]
    plane = Plane((0.0, 0.0, 1.005), (0.1, 0.2, -1.0))
    effect = Contact(plane, thickness=0.02) if kind is Contact else kind()
    effect = effect.with_values(0.5 * effect.scales)
    gravity = torch.tensor([0.0, 9.81, 0.0], dtype=torch.float64)
    around = Surroundings(cloth, (0.3, 0.35), gravity, 25.0, 5)
    return setting((effect,), around, boundary.expand(5, -1, -1), torch.zeros(3).double()).terms


def step_of(cloth: Cloth, rng: np.random.Generator) -> tuple[StepContext, torch.Tensor]:
    """A step with the positions at its end."""
    i, j = np.meshgrid(np.arange(GRID[0]), np.arange(GRID[1]), indexing="ij")
    flat = np.stack((0.05 * i, 0.05 * j, 1 + 0.01 * np.sin(i + 0.7 * j)), -1).reshape(-1, 3)
    before = torch.from_numpy(flat + 0.003 * rng.standard_normal(flat.shape))
    after = torch.from_numpy(flat + 0.003 * rng.standard_normal(flat.shape))
    speed = torch.from_numpy(rng.standard_normal(flat.shape))
    return StepContext(cloth, MATERIAL, before, speed, 0.1, 0.01, before[cloth.pinned]), after


@pytest.mark.parametrize(
    ("name", "own_past"), [(n, n in OWN_PAST) for n in WITH_PAST] + [(n, False) for n in OWN_PAST]
)
def test_few_adjoints_give_the_whole_derivative(
    name: str, own_past: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if name in OWN_PAST:
        monkeypatch.setattr(CATALOGUE[name], "own_past", own_past)
    cloth, rng = cloth_of_grid(), np.random.default_rng(3)
    now, after = step_of(cloth, rng)
    terms = terms_of(name, cloth, now.boundary)
    n = after.numel()
    moved = rng.standard_normal((n, 4)).astype(np.float32)
    faster = rng.standard_normal((n, 4)).astype(np.float32)
    found = one_step(PastForces(terms, cloth), now, after.numpy()).change(moved, faster)

    def forces(x: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
        return term_forces(terms, replace(now, positions=x, velocities=v), after).reshape(-1)

    by_position, by_speed = torch.autograd.functional.jacobian(forces, (now.positions, now.velocities))
    expected = by_position.reshape(n, n).numpy() @ moved + by_speed.reshape(n, n).numpy() @ faster
    assert np.allclose(found, expected, rtol=1e-4, atol=1e-4 * max(np.abs(expected).max(), 1e-6))


@pytest.mark.parametrize("names", [("internal_damping", "strain_stiffening"), ("rest_curvature", "air_drag")])
def test_steps_side_by_side_are_those_one_by_one(names: Sequence[str]) -> None:
    """Beside a tension that is a load's, which every step is asked for by itself."""
    cloth, rng = cloth_of_grid(), np.random.default_rng(4)
    steps = [step_of(cloth, rng) for _ in range(35)]
    tension = TemplateTension(np.full(len(cloth.energies.named("stretching").stencil), 0.02))
    terms = [*chain.from_iterable(terms_of(n, cloth, steps[0][0].boundary) for n in names), tension]
    past = PastForces(terms, cloth)
    moved, faster = rng.standard_normal((2, steps[0][1].numel(), 3)).astype(np.float32)
    together = past.of_steps([(now, after.numpy()) for now, after in steps])
    for (now, after), step in zip(steps[::11], together[::11], strict=True):
        alone = one_step(past, now, after.numpy()).change(moved, faster)
        assert np.abs(alone).max() > 0
        assert np.allclose(step.change(moved, faster), alone, rtol=1e-5, atol=1e-5 * np.abs(alone).max())


class Fading(InternalDamping):
    """As a user might write it."""

    def elements(self, elements: Elements, now: StepContext) -> Elements:
        return super().elements(elements.scaled(bending=math.exp(-now.time)), now)


def test_own_past_is_alike_at_all_times() -> None:
    """Many steps are asked at once, so there is no time that a term could be told."""
    cloth, rng = cloth_of_grid(), np.random.default_rng(5)
    now, after = step_of(cloth, rng)
    fading = Fading().with_values(Fading().scales)
    with pytest.raises(ValueError, match="own past"):
        one_step(PastForces((fading,), cloth), now, after.numpy()).change(
            *np.zeros((2, after.numel(), 1), np.float32)
        )


def test_what_shows_nothing_in_one_step_is_asked_again() -> None:
    """A stiffening grows with the square of the strain: none of the past shows where nothing is strained."""
    cloth = grid_cloth(GRID, (6 / 16, 7 / 16), 0.15, (0, GRID[1] - 1))  # lengths without rounding
    i, j = np.meshgrid(np.arange(GRID[0]), np.arange(GRID[1]), indexing="ij")
    flat = torch.from_numpy(np.stack((i / 16, j / 16, np.ones(GRID)), -1).reshape(-1, 3))
    stiffening = CATALOGUE["strain_stiffening"]()
    past = PastForces((stiffening.with_values(stiffening.scales),), cloth)
    moved = np.random.default_rng(1).standard_normal((flat.numel(), 2)).astype(np.float32)
    sizes = []
    for strained in (1.0, 1.02):
        x = strained * flat
        now = StepContext(cloth, MATERIAL, x, 0 * x, 0.1, 0.01, x[cloth.pinned])
        sizes.append(float(np.abs(one_step(past, now, (1.02 * flat).numpy()).change(moved, 0 * moved)).max()))
        assert past.remember
    assert sizes[0] <= 1e-9 * sizes[1]
