from __future__ import annotations

import math

import pytest
import torch

from toile.errors import InputError
from toile.generation.initial_pose import hanging_sheet, settle
from toile.generation.motion import Still
from toile.generation.settings import GeneratorSettings
from toile.generation.simulation import Sheet, simulate
from toile.generation.starting_point import settled_sheet, starting_point
from toile.physics.simulator import SimulationError


def sheet(**changes: object) -> torch.Tensor:
    options: dict[str, object] = {
        "pinned_distance": 0.8,
        "distance": 1.5,
        "yaw": 0.0,
        "gravity": (0.0, 9.81, 0.0),
        "seed": 0,
    }
    return hanging_sheet((9, 7), (0.5, 0.4), **{**options, **changes})  # type: ignore[arg-type]


def test_sheet_has_the_right_lengths_and_place() -> None:
    p = sheet()
    assert p.shape == (9, 7, 3)
    assert float((p[-1, 0] - p[0, 0]).norm()) == pytest.approx(0.8 * 0.5)
    assert float(p.diff(dim=0).norm(dim=-1).sum(0).mean()) == pytest.approx(0.5, rel=1e-6)
    assert float(p[..., 1].max() - p[..., 1].min()) == pytest.approx(0.4)
    assert float(p[-1, 0, 0]) > float(p[0, 0, 0])  # axis 0 to the right
    assert float(p[0, -1, 1]) > float(p[0, 0, 1])  # axis 1 down
    assert float(p[0, 0, 2]) == pytest.approx(1.5)


def test_sheet_is_bent_asymmetrically_and_by_its_seed() -> None:
    z = sheet()[..., 2] - 1.5
    assert float((z - z.flip(0)).abs().max()) > 0.005
    assert not torch.equal(sheet(), sheet(seed=1))


def test_sheet_hangs_along_tilted_gravity_and_turns_about_it() -> None:
    gravity = (0.4, 9.7, 1.0)
    g = torch.tensor(gravity, dtype=torch.float64)
    g = g / g.norm()
    for yaw in (0.0, 0.6):
        p = sheet(gravity=gravity, yaw=yaw)
        torch.testing.assert_close((p[0, -1] - p[0, 0]) / 0.4, g, atol=1e-9, rtol=0)
        edge = p[-1, 0] - p[0, 0]
        assert float(edge @ g) == pytest.approx(0, abs=1e-12)
    flat = sheet(gravity=gravity)[-1, 0] - sheet(gravity=gravity)[0, 0]
    cosine = float(flat @ edge) / float(flat.norm() * edge.norm())
    assert math.acos(cosine) == pytest.approx(0.6, abs=1e-9)


@pytest.mark.parametrize("changes", [{"pinned_distance": 1.0}, {"gravity": (1.0, 0.0, 0.0)}])
def test_bad_arguments_are_refused(changes: dict[str, object]) -> None:
    with pytest.raises(InputError):
        sheet(**changes)


def test_settled_sheet_is_at_rest(tiny_settings: GeneratorSettings) -> None:
    """Simulated under the same forces it stays where it is: less than 1e-3 m/s² · t²/2."""
    start = starting_point(tiny_settings, None)
    settled = settled_sheet(tiny_settings, start)
    assert settled.grid == (15, 15)
    acceleration = torch.tensor(tiny_settings.gravity, dtype=torch.float64)
    motion = simulate(
        settled,
        pinned_motion=Still(),
        acceleration=acceleration,
        n_frames=5,
        fps=25.0,
        substeps=1,
        newton=tiny_settings.newton,
    )
    assert float((motion - motion[0]).norm(dim=-1).max()) < 1e-3 * 0.16**2
    assert torch.equal(settled.pose[0, 0], start.pose[0, 0])


def test_settling_gives_up_with_a_message(tiny_settings: GeneratorSettings) -> None:
    start = starting_point(tiny_settings, None)
    material = tiny_settings.material(start.cloth_size)
    coarse = Sheet.of(start.pose, start.cloth_size, 0.15, start.pinned, material)
    gravity = torch.tensor(tiny_settings.gravity, dtype=torch.float64)
    with pytest.raises(SimulationError, match="no equilibrium after 2 steps"):
        settle(coarse, gravity, tiny_settings.newton, max_steps=2)
