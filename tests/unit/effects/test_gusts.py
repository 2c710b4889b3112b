"""Gusts that push harder what faces them."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from toile.effects.base import Surroundings
from toile.effects.gusts import FacingGusts, Gusts
from toile.physics.cloth import grid_cloth, grid_material
from toile.physics.step_terms import StepContext

GRID, SIZE, FPS, FRAMES = (7, 6), (0.3, 0.25), 50.0, 41
CLOTH = grid_cloth(GRID, SIZE, 0.15, (0, GRID[1] - 1))
AROUND = Surroundings(CLOTH, SIZE, torch.tensor([0.3, 9.7, 0.5], dtype=torch.float64), FPS, FRAMES)
BLOWING = {"x_1": 0.7, "z_2": -1.3, "z_3": 0.4}
TIME = 0.37


def facing(share: float, around: Surroundings = AROUND) -> FacingGusts:
    """With that share that only pushes what faces them."""
    effect = Gusts(BLOWING).in_detail()
    values = effect.values.clone()
    values[-1] = share - 0.5
    return effect.with_values(values).in_clip(around)


def waves() -> StepContext:
    """A step of a cloth whose normals differ from place to place."""
    i, j = torch.meshgrid(*(torch.linspace(0, s, n) for s, n in zip(SIZE, GRID, strict=True)), indexing="ij")
    sheet = torch.stack((j, i, 0.05 * torch.sin(20 * i) + 0.1 * j**2), -1).reshape(-1, 3).double()
    material = grid_material(*(torch.ones(1).double() for _ in range(3)))
    return StepContext(CLOTH, material, sheet, 0 * sheet, TIME, 0.01, sheet[CLOTH.pinned])


def pushed(effect: FacingGusts, now: StepContext) -> Tensor:
    """Force per mass (N, 3) somewhere else."""
    moved = 0.01 * torch.randn(now.positions.shape, generator=torch.Generator().manual_seed(1)).double()
    ends = (now.positions + moved).requires_grad_()
    force = -torch.autograd.grad(effect.energy(ends, now).sum(), ends, create_graph=True)[0]
    return force / CLOTH.masses[:, None]


def uniform(around: Surroundings = AROUND) -> Tensor:
    """What blows at that time (3,) [m/s²]."""
    return Gusts(BLOWING).acceleration(torch.tensor([TIME], dtype=torch.float64), around)[0, 0]


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_what_faces_them_is_pushed_harder_by_that_share(share: float) -> None:
    now, blowing = waves(), uniform()
    across = (now.normals @ blowing)[:, None] * now.normals
    expected = (1 - share) * blowing + share * across
    torch.testing.assert_close(pushed(facing(share), now), expected, rtol=0, atol=1e-12)
    assert float(across.norm(dim=-1).min()) < 0.8 * float(blowing.norm())


def test_derivatives_are_those_of_the_forces() -> None:
    now, effect = waves(), facing(0.8)
    values = effect.values.clone().requires_grad_()
    rows = CLOTH.masses[:, None] * pushed(effect.with_values(values), now)
    wanted = torch.stack(
        [torch.autograd.grad(force, values, retain_graph=True)[0] for force in rows.flatten()], -1
    )
    found = effect.force_derivatives(now.positions, now)
    torch.testing.assert_close(found, wanted.reshape(found.shape), rtol=0, atol=1e-14)


def test_where_nothing_blows_the_share_says_nothing() -> None:
    now, effect = waves(), Gusts().in_detail().in_clip(AROUND)
    assert effect.is_identity
    assert not effect.force_derivatives(now.positions, now)[-1].any()


def test_in_still_air_they_have_a_mean_and_elsewhere_the_wind_has_it() -> None:
    effect = facing(1.0).in_still_air()
    names = [parameter.name for parameter in effect.parameters]
    assert (names[0], names[-1]) == ("x_0", "facing_beyond_half")
    assert float(effect.value("x_1")) == BLOWING["x_1"]
    assert float(effect.value("facing_beyond_half")) == 0.5
    values = effect.values.clone()
    values[0] = 2.0
    now, blown = waves(), effect.with_values(values)
    still = Surroundings(CLOTH, SIZE, AROUND.gravity, FPS, FRAMES, still_air=True)
    torch.testing.assert_close(pushed(blown.in_clip(AROUND), now), pushed(facing(1.0), now))
    assert not torch.allclose(pushed(blown.in_clip(still), now), pushed(facing(1.0), now), atol=0.1)


def test_longer_clips_have_more_modes_and_the_same_amplitudes() -> None:
    longer = facing(0.2).for_clip(1.58)
    assert len(longer.values) == len(longer.parameters) == 21
    assert {p.name: float(longer.value(p.name)) for p in longer.parameters if longer.value(p.name)} == {
        **BLOWING,
        "facing_beyond_half": pytest.approx(-0.3),
    }


def test_they_know_their_clip_again_after_they_were_stored() -> None:
    effect, now = facing(0.7), waves()
    again = Gusts().in_detail().with_values(effect.values).placed(effect.place())
    assert torch.equal(pushed(again, now), pushed(effect, now))
    other = Surroundings(CLOTH, SIZE, AROUND.gravity, FPS, 2 * FRAMES - 1)
    assert not torch.allclose(pushed(effect.in_clip(other), now), pushed(effect, now), atol=0.1)
    assert Gusts().in_detail().place() == {}


def test_nobody_asks_how_they_blow_where_no_clip_is_said() -> None:
    now = waves()
    with pytest.raises(ValueError, match="in which clip"):
        Gusts(BLOWING).in_detail().energy(now.positions, now)


def test_they_are_as_strong_as_where_the_cloth_faces_them() -> None:
    (strongest,) = facing(1.0).amounts(AROUND, {}, AROUND.frame_times())
    (same,) = Gusts(BLOWING).amounts(AROUND, {}, AROUND.frame_times())
    assert strongest == same
    assert np.isfinite(strongest.value)
