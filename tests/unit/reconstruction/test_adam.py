"""The paper's recipe."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch

from toile.errors import InputError
from toile.physics.simulator import SimulationError
from toile.reconstruction.adam import SuccessiveFramesAdam
from toile.reconstruction.losses.image import ImageLoss
from toile.reconstruction.parameters import ClothParameters
from toile.reconstruction.problem import Reconstruction

MakeProblem = Callable[[], Reconstruction]
MakeAdam = Callable[..., SuccessiveFramesAdam]


def values(problem: Reconstruction) -> dict[str, torch.Tensor]:
    return {name: p.detach().clone() for name, p in problem.parameters.named_parameters()}


def total(losses: dict[str, float]) -> float:
    return sum(losses.values())


def test_frames_are_added_one_by_one(adam: MakeAdam) -> None:
    recipe = adam(first_frames=10, cycles_per_frame=5)
    assert [recipe.n_frames(k, 12) for k in (0, 4, 5, 9, 10, 99)] == [10, 10, 11, 11, 12, 12]
    assert adam(first_frames=None).n_frames(0, 12) == 12


def test_nothing_in_a_fit_is_random(problem: MakeProblem, adam: MakeAdam) -> None:
    after = []
    for seed in (0, 1):
        torch.manual_seed(seed)
        p, recipe = problem(), adam()
        recipe.start(p)
        recipe.cycle(p, 0)
        after.append(values(p))
    for name, value in after[0].items():
        assert torch.equal(after[1][name], value), name


def test_a_few_cycles_lower_the_loss(problem: MakeProblem, adam: MakeAdam) -> None:
    # The learning rates of the wind and the pinned vertices oscillate at first on a scene that small.
    p, recipe = problem(), adam(first_frames=None)
    recipe.start(p)
    losses = [total(recipe.cycle(p, k).losses) for k in range(30)]
    assert losses[-1] < 0.97 * losses[0]


def test_first_step_has_the_length_of_the_learning_rate(problem: MakeProblem, adam: MakeAdam) -> None:
    p, recipe = problem(), adam()
    recipe.start(p)
    before = values(p)
    report = recipe.cycle(p, 0)
    change = {name: (after - before[name]).abs() for name, after in values(p).items()}
    assert report.n_frames == 3
    # Its gradient is only about 20 times Adam's epsilon.
    assert change["stretching"].item() == pytest.approx(50, rel=0.1)
    assert change["shearing"].item() == pytest.approx(0.1, rel=1e-3)
    assert change["bending"].item() == pytest.approx(0.01, rel=1e-3)
    units = p.parameters.units
    force = 1e-3 * units.length / units.time**2
    free = torch.ones(64, dtype=torch.bool)
    free[p.cloth.pinned] = False
    assert change["turbulence"][:2, free].median().item() == pytest.approx(force, rel=1e-2)
    assert change["turbulence"][2:].max() == 0, "frames that are not covered yet"
    assert change["wind"].max().item() == pytest.approx(0.05 * 9.81, rel=1e-2)
    # Pinned vertices: a velocity, so the displacement grows from frame to frame.
    assert change["boundary_motion"][0].max() == 0
    assert change["boundary_motion"][1].median().item() == pytest.approx(1e-3 * units.length, rel=1e-2)
    assert change["texture_offset"].max().item() == pytest.approx(2e-4, rel=1e-2)


def test_wind_stays_horizontal_and_stiffness_above_its_bounds(problem: MakeProblem, adam: MakeAdam) -> None:
    p, recipe = problem(), adam(minimum={"stretching": 3100.0, "shearing": 9.0, "bending": 0.6})
    recipe.start(p)
    for k in range(2):
        recipe.cycle(p, k)
    assert abs(float(p.parameters.wind.detach() @ p.gravity)) < 1e-12
    assert p.parameters.wind.detach().norm() > 0
    assert p.parameters.stretching.item() >= 3100.0
    assert p.parameters.shearing.item() >= 9.0
    assert p.parameters.bending.item() >= 0.6


@pytest.mark.parametrize("name", ClothParameters.NAMES)
def test_a_group_without_learning_rate_stays(name: str, problem: MakeProblem, adam: MakeAdam) -> None:
    p, recipe = problem(), adam()
    recipe = adam(learning_rates={**recipe.learning_rates, name: None})
    recipe.start(p)
    before = values(p)
    recipe.cycle(p, 0)
    moved = {key for key, after in values(p).items() if not torch.equal(after, before[key])}
    assert moved == set(ClothParameters.NAMES) - {name}


@pytest.mark.parametrize("name", ["image", "silhouette", "force_regularization"])
def test_a_term_can_be_left_out(name: str, problem: MakeProblem, adam: MakeAdam) -> None:
    p, recipe = problem(), adam()
    recipe = adam(losses={**recipe.losses, name: None})
    recipe.start(p)
    losses = recipe.cycle(p, 0).losses
    assert set(losses) == {"image", "silhouette", "force_regularization"} - {name}


def test_frames_per_render_is_only_memory(problem: MakeProblem, adam: MakeAdam) -> None:
    after = []
    for size in (1, 2, 8):
        p, recipe = problem(), adam(frames_per_render=size, first_frames=None)
        recipe.start(p)
        losses = recipe.cycle(p, 0).losses
        after.append({**losses, "stretching": p.parameters.stretching.item()})
    for other in after[1:]:
        assert other == pytest.approx(after[0], rel=1e-5)


def test_a_failing_update_is_halved(
    problem: MakeProblem, adam: MakeAdam, monkeypatch: pytest.MonkeyPatch
) -> None:
    p, recipe = problem(), adam()
    recipe.start(p)
    recipe.cycle(p, 0)
    before, simulate, failures = values(p), p.simulate, 2

    def failing(*args: Any, **kwargs: Any) -> Any:
        nonlocal failures
        failures -= 1
        if failures >= 0:
            raise SimulationError("too stiff")
        return simulate(*args, **kwargs)

    monkeypatch.setattr(p, "simulate", failing)
    monkeypatch.setattr(recipe._optimizer, "step", lambda: None)
    report = recipe.cycle(p, 1)
    assert report.notes == ("the last update was halved: too stiff",) * 2
    assert p.parameters.stretching.item() == pytest.approx(3000 + (before["stretching"].item() - 3000) / 4)
    torch.testing.assert_close(p.parameters.boundary_motion.detach(), before["boundary_motion"] / 4)


def test_a_failure_from_the_start_is_raised(
    problem: MakeProblem, adam: MakeAdam, monkeypatch: pytest.MonkeyPatch
) -> None:
    p, recipe = problem(), adam()
    recipe.start(p)

    def failing(*args: Any, **kwargs: Any) -> Any:
        raise SimulationError("too stiff")

    monkeypatch.setattr(p, "simulate", failing)
    with pytest.raises(SimulationError, match="too stiff"):
        recipe.cycle(p, 0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"learning_rates": {"gravity": 1.0}}, "gravity"),
        ({"minimum": {"wind": 1.0}}, "stretching, shearing, bending"),
        ({"first_frames": 1}, "at least 2"),
        ({"cycles_per_frame": 0}, "at least 1"),
        ({"losses": {"image": None}}, "looks at the video"),
    ],
)
def test_bad_settings(changes: dict[str, Any], message: str, adam: MakeAdam) -> None:
    with pytest.raises(InputError, match=message):
        adam(**changes)


def test_no_pinned_vertices(problem: MakeProblem, adam: MakeAdam) -> None:
    p = problem()
    p.parameters.boundary_motion = torch.nn.Parameter(p.parameters.boundary_motion[:, :0].detach().clone())
    recipe = adam(losses={"image": ImageLoss(1.0)})
    recipe.start(p)
    assert "boundary_motion" not in recipe._variables
