"""What an obstacle pushes, with a history of its own."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from toile.effects.base import Effect, VertexEffect
from toile.effects.contact import Contact, ContactPush
from toile.effects.obstacles import Plane, Sphere
from toile.physics.cloth import grid_cloth, grid_material
from toile.physics.step_terms import StepContext

GRID, SIZE = (6, 5), (0.25, 0.2)
CLOTH = grid_cloth(GRID, SIZE, 0.15, (0, GRID[1] - 1))
BALL = Contact(Sphere([0.1, 0.1, 0.1], 0.1), thickness=0.02)
TIME, DURATION = 0.3, 0.8


def bent() -> StepContext:
    """A step of a cloth of which a part is within the ball's margin, and a part is not."""
    i, j = torch.meshgrid(*(torch.linspace(0, s, n) for s, n in zip(SIZE, GRID, strict=True)), indexing="ij")
    sheet = torch.stack((j, i, 0.02 * torch.sin(20 * i) * j), -1).reshape(-1, 3).double()
    material = grid_material(*(torch.ones(1).double() for _ in range(3)))
    return StepContext(CLOTH, material, sheet, 0 * sheet, TIME, 0.01, sheet[CLOTH.pinned])


def ends_of(now: StepContext) -> Tensor:
    """Where the step ends, somewhere else."""
    moved = 0.01 * torch.randn(now.positions.shape, generator=torch.Generator().manual_seed(1)).double()
    return now.positions + moved


def pushed(effect: Effect, now: StepContext) -> Tensor:
    """Force per mass (N, 3) there."""
    assert isinstance(effect, VertexEffect)
    ends = ends_of(now).requires_grad_()
    force = -torch.autograd.grad(effect.energy(ends, now).sum(), ends, create_graph=True)[0]
    return force / CLOTH.masses[:, None]


def pushing(contact: Contact = BALL) -> ContactPush:
    effect = contact.pushing(DURATION)
    values = torch.zeros(len(effect.parameters), dtype=torch.float64)
    values[0], values[2] = 300.0, -900.0
    return effect.with_values(values)


def test_it_pushes_out_of_the_obstacle_as_deep_as_the_margin_is_entered() -> None:
    now, ball = bent(), torch.tensor([0.1, 0.1, 0.1], dtype=torch.float64)
    away = ends_of(now) - ball
    depth = (0.12 - away.norm(dim=-1)).clamp(min=0)
    assert 3 < int((depth > 0).sum()) < len(depth)
    hard = 300 - 900 * math.cos(2 * math.pi * TIME / DURATION)
    expected = hard * depth[:, None] * away / away.norm(dim=-1, keepdim=True)
    torch.testing.assert_close(pushed(pushing(), now), expected, rtol=0, atol=1e-12)


def test_derivatives_are_those_of_the_forces() -> None:
    now, effect = bent(), pushing()
    values = effect.values.clone().requires_grad_()
    rows = CLOTH.masses[:, None] * pushed(effect.with_values(values), now)
    wanted = torch.stack(
        [torch.autograd.grad(force, values, retain_graph=True)[0] for force in rows.flatten()], -1
    )
    found = effect.force_derivatives(ends_of(now), now)
    torch.testing.assert_close(found, wanted.reshape(found.shape), rtol=0, atol=1e-14)


def test_as_hard_all_the_time_it_is_contact_without_friction() -> None:
    wall = Contact(Plane([0.0, 0.0, -0.004], [0.0, 0.1, 1.0]), {"stiffness": 500.0}, thickness=0.01)
    now, effect = bent(), wall.pushing(DURATION)
    values = torch.zeros(len(effect.parameters), dtype=torch.float64)
    values[0] = 500.0
    assert pushed(wall, now).any()
    torch.testing.assert_close(pushed(effect.with_values(values), now), pushed(wall, now))


def test_it_is_as_fast_as_gusts_may_be_and_nobody_is_pushed_by_what_nobody_knows() -> None:
    assert [p.name for p in Contact().pushing(1.58).parameters] == [f"push_{k}" for k in range(11)]
    assert not pushed(pushing(Contact()), bent()).any()
    assert Contact().pushing(1.0).NAME == "contact"
    assert Contact().pushing(1.0).is_identity
