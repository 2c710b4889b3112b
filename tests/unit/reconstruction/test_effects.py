"""Effects in a fit: what is free, in what bounds, and that their numbers are found again."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from toile.effects.air_drag import AirDrag
from toile.effects.anchor_slip import AnchorSlip
from toile.effects.base import Effect
from toile.effects.frame_rate import FrameRate
from toile.effects.gusts import Gusts
from toile.effects.shading import Shading
from toile.errors import InputError
from toile.physics.cloth import Cloth
from toile.physics.implicit.integrators import BDF2
from toile.physics.implicit.newton import NewtonSettings
from toile.physics.implicit.simulator import ImplicitSimulator
from toile.physics.step_terms import StepTerm
from toile.reconstruction.adam import SuccessiveFramesAdam
from toile.reconstruction.effects import FitEffects
from toile.reconstruction.gauss_newton.recipe import SlidingWindows, TrackingRecipe, TrackingStage
from toile.reconstruction.gauss_newton.unknowns import Priors, WindowUnknowns
from toile.reconstruction.gauss_newton.window import minimise_window, state_at
from toile.reconstruction.image_terms.texture_points import PointTermSettings
from toile.reconstruction.image_terms.tracked_positions import PositionTermSettings, TrackedPositionTerm
from toile.reconstruction.parameters import ClothParameters
from toile.reconstruction.problem import Reconstruction
from toile.reconstruction.scene_cloth import scene_cloth, scene_units, uniform
from toile.rendering import WarpRenderer
from toile.scenes.scene import Scene

STIFFNESS = np.array([3000.0, 10.0, 0.5])
ALONE = Priors(None, 1.0, 2.0, None, 3.0, None, None, walk=False, effects=1.0)


@pytest.fixture
def problem(swaying_scene: Scene) -> Callable[..., Reconstruction]:
    """Makes the problem with some effects."""

    def make(effects: Sequence[Effect] = (), fixed: Sequence[str] = ()) -> Reconstruction:
        cloth = scene_cloth(swaying_scene, 0.15, uniform)
        parameters = ClothParameters(
            swaying_scene.n_frames,
            cloth.n_vertices,
            len(cloth.pinned),
            scene_units(swaying_scene, 0.15),
            stretching=STIFFNESS[0],
            shearing=STIFFNESS[1],
            bending=STIFFNESS[2],
        )

        def simulator(
            cloth: Cloth, step: float | Tensor, terms: Sequence[StepTerm] = ()
        ) -> ImplicitSimulator:
            return ImplicitSimulator(cloth, step, BDF2(), NewtonSettings(), terms)

        return Reconstruction(
            swaying_scene, cloth, simulator, 2, parameters, WarpRenderer(), FitEffects(effects, fixed)
        )

    return make


def found(made: Reconstruction, tracked: Tensor, deviation: float = 1e-8) -> list[float]:
    """Numbers of the effects, fitted to positions."""
    n = made.scene.n_frames
    minimise_window(
        made,
        WindowUnknowns(made, ALONE, STIFFNESS, 0, n - 1),
        TrackedPositionTerm(tracked.numpy(), PositionTermSettings(deviation)),
        None,
        state_at(made, None, 0),
        None,
        iterations=12,
        cg_iterations=30,
        cg_tolerance=1e-8,
    )
    return made.effects.current().tolist()


def motion(made: Reconstruction) -> Tensor:
    with torch.no_grad():
        return made.simulate(made.scene.n_frames).positions[0]


def test_what_is_free() -> None:
    effects = FitEffects((AirDrag({"normal": 0.5}), Gusts(n_modes=1), FrameRate()), fixed=("gusts",))
    assert effects.names == (
        "air_drag linear [1/s]",
        "air_drag normal [1/s]",
        "air_drag quadratic [1/m]",
        "frame_rate log_factor [1]",
    )
    assert effects.in_step_terms.tolist() == [True, True, True, False]
    assert effects.change_inertia
    assert effects.start.tolist() == [0.0, 0.5, 0.0, 0.0]
    assert effects.low.tolist() == [0.0, 0.0, 0.0, -0.7]
    drag, gusts, rate = effects.acting(torch.tensor([1.0, 2.0, 3.0, 0.1], dtype=torch.float64))
    assert drag.values.tolist() == [1.0, 2.0, 3.0]
    assert gusts.is_identity
    assert not gusts.values.requires_grad
    assert rate.values.tolist() == [0.1]
    assert effects.coefficients()["gusts x_1 [m/s²]"] == 0.0
    assert list(effects.state_dict()) == ["values"]


def test_no_effects_leave_no_trace(problem: Callable[..., Reconstruction]) -> None:
    made = problem()
    assert not list(made.effects.state_dict())
    assert made.simulator_of(made.setting()) is made.simulator
    unknowns = WindowUnknowns(made, ALONE, STIFFNESS, 0, 2)
    assert "effects" not in unknowns.start()
    assert unknowns.inputs(unknowns.start(), linearize=True).simulator is made.simulator


def test_effects_at_zero_are_the_identity(problem: Callable[..., Reconstruction]) -> None:
    zeros = problem((AirDrag(), Gusts(), FrameRate(), AnchorSlip()))
    assert torch.equal(motion(zeros), motion(problem()))


@pytest.mark.parametrize(
    ("effects", "fixed", "message"),
    [
        ((AirDrag(), Shading()), (), "none on the image"),
        ((AirDrag(),), ("gusts",), "no effect of the fit"),
        ((AirDrag(), AirDrag()), (), "acts twice"),
    ],
)
def test_what_a_fit_does_not_take(effects: Sequence[Effect], fixed: Sequence[str], message: str) -> None:
    with pytest.raises(InputError, match=message):
        FitEffects(effects, fixed)


@pytest.mark.parametrize(
    "truth",
    [
        AirDrag({"linear": 0.5, "normal": 2.0, "quadratic": 1.0}),
        Gusts({"x_1": 1.0, "z_1": -2.0}, n_modes=1),
        AnchorSlip({"x": 0.01, "y": -0.02, "z": 0.03}, start=0.0, duration=0.05),
        FrameRate({"log_factor": 0.05}),
    ],
    ids=lambda effect: effect.NAME,
)
def test_numbers_from_exact_positions(problem: Callable[..., Reconstruction], truth: Effect) -> None:
    """Positions that the simulator itself made: the numbers are found from zero."""
    tracked = motion(problem((truth,)))
    zero = truth.with_values(torch.zeros_like(truth.values))
    values = found(problem((zero,)), tracked)
    np.testing.assert_allclose(values, truth.values, atol=5e-3 * float(truth.values.abs().max()))


def test_bounds_hold(problem: Callable[..., Reconstruction]) -> None:
    """Positions of a cloth that something drives: drag stays at its bound, the rest is fitted."""
    tracked = motion(problem((Gusts({"z_1": 4.0}, n_modes=1),)))
    made = problem((AirDrag({"normal": 1.0}), Gusts(n_modes=1)))
    linear, normal, quadratic, _, across = found(made, tracked, 1e-5)
    assert min(linear, normal, quadratic) >= 0.0
    assert across == pytest.approx(4.0, abs=0.05)
    assert max(linear, normal, quadratic) < 0.1


def test_fixed_numbers_stay(problem: Callable[..., Reconstruction]) -> None:
    truth = (AirDrag({"normal": 2.0}), Gusts({"x_1": 1.0}, n_modes=1))
    made = problem((truth[0], Gusts(n_modes=1)), ("air_drag",))
    assert found(made, motion(problem(truth))) == pytest.approx([1.0, 0.0], abs=1e-3)
    assert made.effects.coefficients()["air_drag normal [1/s]"] == 2.0


def test_windows_join_into_one_simulation(problem: Callable[..., Reconstruction]) -> None:
    """Velocities at the begin of a window are those that the simulation before has left."""
    made = problem((AirDrag({"quadratic": 8.0}), FrameRate({"log_factor": 0.1})))
    stage = TrackingStage(
        windows=SlidingWindows(2, 1, 1),
        term=PointTermSettings(24, 1.0, None, 4096.0, 50.0),
        priors=Priors(10.0, 1.0, 2.0, 0.01, 3.0, None, None, walk=False),
        iterations=1,
        cg_iterations=10,
        cg_tolerance=1e-2,
        visibility=False,
        settle=False,
        discard_turbulence=False,
    )
    recipe = TrackingRecipe({"track": stage})
    torch.manual_seed(0)
    recipe.start(made)
    for index in range(recipe.n_cycles(made)):
        positions = recipe.cycle(made, index).positions
    torch.testing.assert_close(motion(made), positions, atol=1e-9, rtol=0)


def test_adam_moves_the_numbers_within_bounds(
    problem: Callable[..., Reconstruction], adam: Callable[..., SuccessiveFramesAdam]
) -> None:
    rates: dict[str, Any] = {"effects": 0.5}
    recipe = adam(learning_rates=rates, cycles=4, first_frames=None)
    made = problem((AirDrag(), Gusts(n_modes=1)))
    recipe.start(made)
    for index in range(4):
        recipe.cycle(made, index)
    values = made.effects.current()
    assert bool(values.any())
    assert bool(((values >= made.effects.low) & (values <= made.effects.high)).all())
