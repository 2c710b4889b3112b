"""Where on the cloth an effect acts."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from toile.effects.anchor_slip import AnchorSlip
from toile.effects.base import Surroundings
from toile.effects.catalogue import CATALOGUE
from toile.effects.contact import Contact
from toile.effects.nonuniform_density import NonuniformDensity
from toile.effects.nonuniform_stiffness import NonuniformStiffness
from toile.effects.obstacles import Plane
from toile.effects.rest_curvature import RestCurvature
from toile.physics.cloth import grid_cloth
from toile.physics.grid_lines import GridLines

GRID, SIZE = (9, 11), (0.4, 0.5)
GRAVITY = torch.tensor([0.0, 9.81, 0.0], dtype=torch.float64)


@pytest.fixture(scope="module", params=[0.0, 0.5])
def around(request: pytest.FixtureRequest) -> Surroundings:
    lines = GridLines.crowded(*GRID, request.param)
    cloth = grid_cloth(GRID, SIZE, 0.15, (0, GRID[1] - 1), lines=lines)
    return Surroundings(cloth, SIZE, GRAVITY, 50.0, 3)


def flat(around: Surroundings) -> torch.Tensor:
    u, v = around.cloth.lines.places()
    x, y = SIZE[1] * v, SIZE[0] * u
    place = torch.stack((x.repeat(GRID[0]), y.repeat_interleave(GRID[1]), torch.ones(GRID[0] * GRID[1])), -1)
    return place.to(torch.float64).expand(3, -1, 3).clone()


@pytest.mark.parametrize("kind", [NonuniformDensity, NonuniformStiffness])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_patch_is_where_it_differs_from_most_of_the_cloth(
    kind: type[NonuniformDensity] | type[NonuniformStiffness], sign: float, around: Surroundings
) -> None:
    effect = kind(half_waves=3)
    modes = {p.name: k for k, p in enumerate(effect.parameters)}
    values = torch.zeros(len(modes), dtype=torch.float64)
    # Most at u = 0, v = 0.
    for name in ("mode_10", "mode_01", "mode_11", "mode_20", "mode_02", "mode_21", "mode_12", "mode_22"):
        values[modes[name]] = sign * 0.2
    found = effect.with_values(values).acts_on(around, flat(around))
    assert bool((found >= 0).all())
    assert int(found.argmax()) == 0
    assert float(found[0]) > 4 * float(found.median())


def test_a_fold_is_where_its_moment_is(around: Surroundings) -> None:
    effect = RestCurvature(half_waves=4)
    names = [p.name for p in effect.parameters]
    values = torch.zeros(len(names), dtype=torch.float64)
    # Along grid axis 1: cos 2πv and cos 4πv with a mean are a band in the middle.
    values[names.index("axis_1")] = 1e-3
    values[names.index("axis_1_2")], values[names.index("axis_1_4")] = -1e-3, 1e-3
    found = effect.with_values(values).acts_on(around, flat(around))
    assert found is not None
    _, v = around.cloth.lines.places()
    expected = 1e-3 * (1 - torch.cos(2 * torch.pi * v) + torch.cos(4 * torch.pi * v)).abs()
    torch.testing.assert_close(found.reshape(GRID), expected.expand(GRID), rtol=1e-12, atol=1e-15)


def test_the_same_curvature_everywhere_is_in_no_place(around: Surroundings) -> None:
    assert RestCurvature({"axis_0": 1e-3}).acts_on(around, flat(around)) is None


def test_contact_is_where_the_margin_is_entered(around: Surroundings) -> None:
    motion = flat(around)
    touched = Contact(Plane((0.4, 0.0, 0.0), (-1.0, 0.0, 0.0)), thickness=0.02)
    found = touched.acts_on(around, motion)
    np.testing.assert_array_equal(found.numpy() > 0, motion[0, :, 0].numpy() > 0.38)
    assert float(Contact().acts_on(around, motion).max()) == 0


@pytest.mark.parametrize("vertex", [0, 1])
def test_a_slip_is_where_the_holder_is(vertex: int, around: Surroundings) -> None:
    found = AnchorSlip(vertex=vertex).acts_on(around, flat(around))
    assert int(found.argmax()) == int(around.cloth.pinned[vertex])
    assert float(found.max()) == 1.0
    assert float(found.min()) == 0.0


@pytest.mark.parametrize("name", ["air_drag", "gusts", "gravity_tilt", "internal_damping", "frame_rate"])
def test_what_acts_everywhere_is_in_no_place(name: str, around: Surroundings) -> None:
    assert CATALOGUE[name]().acts_on(around, flat(around)) is None
