"""The balance of torques: a cause from outside is found whatever the law, one within leaves no trace."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from toile.diagnosis.force_modes import balanced_directions
from toile.diagnosis.torque_balance import MovingCloth, torque_evidence
from toile.effects.base import Effect, Surroundings
from toile.effects.catalogue import CATALOGUE, OUTSIDE
from toile.effects.setting import setting
from toile.geometry.horizontal import horizontal_axes
from toile.physics.cloth import grid_cloth, grid_material
from toile.physics.implicit.integrators import BDF2
from toile.physics.implicit.newton import NewtonSettings
from toile.physics.implicit.simulator import ImplicitSimulator
from toile.physics.rollout import rollout
from toile.physics.state import State

GRID, SIZE, FRAMES, FPS = (7, 7), (0.4, 0.4), 60, 50.0
GRAVITY = torch.tensor([0.0, 9.81, 0.0], dtype=torch.float64)


def swinging(*effects: Effect, pinned: tuple[int, ...] = (0, 42), wind: float = 0.0) -> MovingCloth:
    """A cloth that swings down from two corners, with effects."""
    cloth = grid_cloth(GRID, SIZE, 0.15, pinned)
    around = Surroundings(cloth, SIZE, GRAVITY, FPS, FRAMES)
    i, j = torch.meshgrid(torch.arange(GRID[0]), torch.arange(GRID[1]), indexing="ij")
    h = SIZE[0] / (GRID[0] - 1)
    x = torch.stack((i * h, 0.8 * j * h, 1 + 0.6 * j * h), -1).reshape(1, -1, 3).double()
    horizontal = horizontal_axes(GRAVITY)
    given = setting(
        effects,
        around,
        x[0, cloth.pinned].expand(FRAMES, -1, -1),
        wind * horizontal[0] + wind * horizontal[1],
    )
    step = 1 / FPS / 2
    simulator = ImplicitSimulator(given.cloth, step, BDF2(), NewtonSettings(1e-8), given.terms)
    k = torch.tensor([[800.0], [0.01], [1e-4]], dtype=torch.float64)
    state = State.start(x, torch.zeros_like(x), step, simulator.n_past)
    with torch.no_grad():
        motion = rollout(
            simulator, state, grid_material(*k), given.forces[None], given.boundary[None], 2
        ).positions[0]
    return MovingCloth(motion.numpy(), around, horizontal.numpy())


def candidates() -> list[Effect]:
    return [CATALOGUE[name]().for_clip(FRAMES / FPS) for name in OUTSIDE]


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("air_drag", {"linear": 1.0}),
        ("nonuniform_density", {"mode_01": 0.4}),
        ("gusts", {"x_3": 0.5, "z_3": 1.0}),
    ],
)
def test_a_cause_from_outside_leads(name: str, values: dict[str, float]) -> None:
    found = torque_evidence([swinging(CATALOGUE[name](values), wind=0.3)], candidates())
    assert found is not None
    assert max(found, key=lambda one: found[one]) == name
    assert found[name] > 10


def test_a_wrong_clock_leads() -> None:
    clip = swinging(wind=0.3)
    declared = replace(clip, around=replace(clip.around, fps=1.15 * FPS))
    found = torque_evidence([declared], candidates())
    assert found is not None
    assert max(found, key=lambda one: found[one]) == "frame_rate"
    assert found["frame_rate"] > 8


@pytest.mark.parametrize(
    "within",
    [
        (),
        (CATALOGUE["internal_damping"]({"in_plane": 0.05, "bending": 0.3}),),
        (CATALOGUE["anisotropic_stiffness"]({"stretching": 1.5, "bending": 1.5}),),
        (CATALOGUE["rest_curvature"]({"axis_0": 8e-4}),),
    ],
)
def test_what_acts_within_the_cloth_leaves_no_trace(within: tuple[Effect, ...]) -> None:
    found = torque_evidence([swinging(*within, wind=0.3)], candidates())
    assert found is not None
    # What steps of 10 ms are wrong by looks like a clock that is.
    assert max(found.values()) < 5


def test_two_clips_say_more_than_one() -> None:
    clips = [swinging(CATALOGUE["air_drag"]({"linear": 0.3}), wind=wind) for wind in (0.0, 0.5)]
    alone, both = torque_evidence(clips[:1], candidates()), torque_evidence(clips, candidates())
    assert alone is not None
    assert both is not None
    assert both["air_drag"] > alone["air_drag"] > 0


def test_it_is_sure_of_less_where_positions_jitter() -> None:
    clip = swinging(CATALOGUE["air_drag"]({"linear": 1.0}))
    rng = np.random.default_rng(0)
    noisy = replace(clip, positions=clip.positions + 1e-3 * rng.standard_normal(clip.positions.shape))
    clear, blurred = torque_evidence([clip], candidates()), torque_evidence([noisy], candidates())
    assert clear is not None
    assert blurred is not None
    assert blurred["air_drag"] < clear["air_drag"]


def test_three_corners_take_up_every_torque() -> None:
    assert torque_evidence([swinging(pinned=(0, 42, 45))], candidates()) is None
    corners = np.array([[0.0, 0, 0], [0.4, 0, 0], [0.1, 0.3, 0]])
    assert len(balanced_directions(corners, 0.4)) == 0
    line = balanced_directions(corners[:2], 0.4)
    assert np.allclose(np.abs(line), [[0, 0, 0, 1, 0, 0]], atol=1e-12)
