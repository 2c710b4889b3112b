"""Hypotheses fitted to several clips at once, without a free force: the cause gains, its rivals do not."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch

from toile.diagnosis import outside_causes
from toile.diagnosis.base_fit import base_of, base_sensitivities, local_scales, nothing_seen
from toile.diagnosis.effect_size import Displacements
from toile.diagnosis.hem import Hem
from toile.diagnosis.image_information import as_array
from toile.diagnosis.joint_fit import (
    JointClip,
    JointFit,
    JointFitSettings,
    JointFitting,
    SharedLayout,
    fitted_velocities,
    joint_clip,
)
from toile.diagnosis.left_out import left_out_shrinks
from toile.diagnosis.model_errors import ModelErrors, model_errors
from toile.diagnosis.outside_causes import OutsideCauses, judged
from toile.diagnosis.refits import acting_with
from toile.diagnosis.session_alias import session_alias
from toile.diagnosis.session_settings import SessionSettings
from toile.diagnosis.shooting import Shooting, ShootingSettings, WindowMotion, cosine_modes
from toile.diagnosis.softened import ModelError, softened
from toile.diagnosis.stored_values import ValueStore
from toile.diagnosis.touched_obstacles import Met, Swept, TouchedObstacles, _Pushes, touching
from toile.diagnosis.tracked import Tracked
from toile.effects.base import Effect, Scope, Surroundings
from toile.effects.catalogue import CATALOGUE, OUTSIDE
from toile.effects.contact import Contact
from toile.effects.gusts import Gusts
from toile.effects.obstacles import Plane, Sphere
from toile.effects.rest_curvature import RestCurvature
from toile.effects.setting import setting
from toile.physics.cloth import grid_cloth
from toile.physics.grid_laws import GridLaw, angles, taut_fitted
from toile.physics.grid_lines import GridLines
from toile.physics.implicit.integrators import BDF2
from toile.physics.implicit.newton import NewtonSettings
from toile.physics.implicit.simulator import ImplicitSimulator
from toile.physics.material import Material
from toile.physics.rollout import rollout
from toile.physics.state import State
from toile.physics.step_terms import StepContext
from toile.workers import ALONE

GRID = (6, 6)
FRAMES, FPS, SUBSTEPS = 13, 25.0, 4
STIFFNESS = np.array([400.0, 2e-3, 1e-4])
GRAVITY = np.array([0.0, 9.81, 0.0])
HORIZONTAL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
WINDS = ((0.0, 0.5), (0.6, -0.4))
DRAG = 1.2  # 1/s, linear
CURL = 2e-3  # N, 10 / m


def clip(
    wind: tuple[float, float],
    effects: tuple[Effect, ...],
    law: GridLaw | None = None,
    material: np.ndarray = STIFFNESS,
) -> tuple[Shooting, Surroundings]:
    """A cloth that swings down in a wind; its motion is known."""
    cloth = grid_cloth(GRID, (0.3, 0.3), 0.15, (0, (GRID[0] - 1) * GRID[1]), law=law or angles)
    around = Surroundings(cloth, (0.3, 0.3), torch.from_numpy(GRAVITY), FPS, FRAMES)
    i, j = torch.meshgrid(torch.arange(GRID[0]), torch.arange(GRID[1]), indexing="ij")
    depth = 1 + 0.5 * j * 0.06 + 0.01 * torch.sin(1.1 * i)
    start = torch.stack((0.94 * i * 0.06, 0.85 * j * 0.06, depth), -1).reshape(1, -1, 3).double()
    boundary = start[0, cloth.pinned].expand(FRAMES, -1, -1)
    given = setting(effects, around, boundary, torch.from_numpy(np.array(wind) @ HORIZONTAL))
    h = 1 / FPS / SUBSTEPS
    true_h = float(given.frame_interval) / SUBSTEPS
    real = ImplicitSimulator(given.cloth, true_h, BDF2(), NewtonSettings(1e-8), given.terms)
    numbers = Material(cloth.energies.parameters, torch.from_numpy(material)[None])
    state = State.start(start, torch.zeros_like(start), true_h, real.n_past)
    with torch.no_grad():
        motion = rollout(real, state, numbers, given.forces[None], given.boundary[None], SUBSTEPS)
    positions = motion.positions[0].numpy()
    n = 3 * positions.shape[1]
    seen = [np.eye(n, dtype=np.float32) / 0.002**2] * FRAMES
    tracked = Tracked(positions, seen, np.zeros_like(positions), positions)
    model = ImplicitSimulator(cloth, h, BDF2(), NewtonSettings(1e-4))
    settings = ShootingSettings(modes=2, likelihood_weight=1.0, window=6)
    pinned = positions[:, cloth.pinned.numpy()]
    return Shooting(model, SUBSTEPS, GRAVITY, HORIZONTAL, GRID, pinned, tracked, settings), around


def drag(value: float) -> Effect:
    return CATALOGUE["air_drag"]({"linear": value})


class Problem(NamedTuple):
    """Fits of the base model, and of the effect that acts or might."""

    fitting: JointFitting
    start: JointFit
    base: JointFit
    drag: JointFit


def problem(effects: tuple[Effect, ...]) -> Problem:
    """Two clips in different winds; fits begin far from the truth."""
    clips = [joint_clip(*clip(wind, effects), FRAMES) for wind in WINDS]
    fitting = JointFitting(clips, 1.5 * STIFFNESS, np.zeros(3))
    start = fitting.start_fit()
    base = fitting.fitted((), start)
    return Problem(fitting, start, base, fitting.fitted((drag(0.0),), base))


@pytest.fixture(scope="module")
def dragged() -> Problem:
    """With drag."""
    return problem((drag(DRAG),))


@pytest.fixture(scope="module")
def still() -> Problem:
    """The same without."""
    return problem(())


@pytest.fixture(scope="module")
def damped() -> tuple[JointFitting, JointFit, JointFit]:
    """A cloth with internal damping: without the usual effect, and with it."""
    acting = CATALOGUE["internal_damping"]({"in_plane": 0.02, "bending": 0.2})
    clips = [joint_clip(*clip(wind, (acting,)), FRAMES) for wind in WINDS]
    usual = (CATALOGUE["internal_damping"](),)
    fitting = JointFitting(clips, 1.2 * STIFFNESS, np.zeros(3), usual=usual)
    plain = fitting.fitted((), fitting.start_fit())
    return fitting, plain, fitting.fitted(fitting.usual, plain)


@pytest.fixture(scope="module")
def curled() -> tuple[JointFitting, JointFit, Effect]:
    """A curling cloth whose base model has ended with next to no bending stiffness."""
    material = np.array([400.0, 2e-3, 2e-4])
    curl = CATALOGUE["rest_curvature"]({"axis_0": CURL})
    clips = [joint_clip(*clip(wind, (curl,), material=material), FRAMES) for wind in WINDS]
    # So few that only what begins near arrives.
    settings = JointFitSettings(passes=2)
    soft = JointFitting(clips, material, np.array([0.0, 0.0, -5.0]), settings).start_fit()
    return JointFitting(clips, material, np.zeros(3), settings), soft, CATALOGUE["rest_curvature"]()


class TestFits:
    def test_whoever_asks_for_no_spread_is_spared_the_last_tangents_alone(
        self, dragged: Problem, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        made = []
        tangents = JointFitting._evidence

        def counted(self: JointFitting, *given: object, **more: object) -> object:
            made.append(self)
            return tangents(self, *given, **more)  # type: ignore[arg-type]

        monkeypatch.setattr(JointFitting, "_evidence", counted)
        of_one_pass = replace(dragged.fitting.settings, passes=1)
        fitting = JointFitting(dragged.fitting.clips, dragged.fitting.start, np.zeros(3), of_one_pass)
        whole = fitting.fitted((drag(0.0),), dragged.base)
        assert len(made) == 2
        without = fitting.fitted((drag(0.0),), dragged.base, spread=False)
        assert len(made) == 3
        np.testing.assert_array_equal(without.coefficients, whole.coefficients)
        assert without.misfit == whole.misfit
        assert without.history == whole.history
        assert without.converged == whole.converged

    def test_an_effect_that_no_step_strengthens_is_in_the_model_all_the_same(self, still: Problem) -> None:
        """Where a fit gains nothing, whoever asks for its effects must find them, at zero."""
        content = replace(still.fitting.settings, nothing=1e9)
        fitting = JointFitting(still.fitting.clips, still.fitting.start, np.zeros(3), content)
        found = fitting.fitted((drag(0.0),), still.base)
        assert len(found.history) == len(still.base.history)
        assert [[e.NAME for e in acting] for acting in found.effects] == [["air_drag"]] * len(WINDS)
        assert all(not acting[0].is_active for acting in found.effects)

    def test_the_base_model_finds_what_made_its_clips(self, still: Problem) -> None:
        base = still.base
        assert base.converged
        assert base.misfit < 0.02 * still.start.misfit
        assert np.exp(base.values[:3]) * 1.5 == pytest.approx(1.0, abs=0.25)
        assert base.values[3:] == pytest.approx(np.concatenate(WINDS), abs=0.15)

    def test_windows_out_of_balance_do_not_hold_up_the_others(self, still: Problem) -> None:
        """Sub-steps of one clip that end short of their tolerance: every step of the fit has such windows."""
        clips = [joint_clip(*clip(wind, ()), FRAMES) for wind in WINDS]
        clips[1].shooting.simulator.newton = NewtonSettings(1e-12, max_iterations=3)
        fitting = JointFitting(clips, 1.5 * STIFFNESS, np.zeros(3))
        start = fitting.start_fit()
        assert all(window.converged for window in start.windows[0])
        assert not any(window.converged for window in start.windows[1])
        found = fitting.fitted((), start)
        assert found.misfit < 0.05 * start.misfit
        assert found.values[:3] == pytest.approx(still.base.values[:3], abs=0.1)
        # What was in balance stays so; with the rest as it is the fit has not arrived.
        assert all(window.converged for window in found.windows[0])
        assert not found.converged

    def test_a_fit_without_a_way_on_has_not_arrived(
        self, still: Problem, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        assert still.base.converged
        monkeypatch.setattr(JointFitting, "_moved", lambda *_: None)
        halted = still.fitting.fitted((), still.start)
        assert halted.misfit == still.start.misfit
        assert not halted.converged
        # Where nothing is promised, it has.
        assert still.fitting.fitted((), still.base).converged

    def test_how_far_an_effect_moves_the_cloth(self, dragged: Problem) -> None:
        """As far as the clips themselves say: with the drag against without it, all else equal."""
        fit, fitting = dragged.drag, dragged.fitting
        moved_by = Displacements(fitting.clips, fitting.start, 0.3)
        found = moved_by.of(fit)
        far = found.last
        assert found.frames.shape == (FRAMES,)
        assert found.frames[0] == 0.0
        assert found.frames[2 * (FRAMES - 1) // 3 + 1 :].mean() == pytest.approx(far, rel=0.1)
        of_clips = [clip(WINDS[0], effects)[0].tracked.positions for effects in (fit.effects[0], ())]
        away = np.linalg.norm(of_clips[0] - of_clips[1], axis=-1)[2 * FRAMES // 3 :].mean() / 0.3
        assert far == pytest.approx(away, rel=0.4)
        # Half the effect moves it by about half as much, none of it by nothing.
        (acting,) = fit.effects[0]
        half = acting_with(acting, 0.5 * fit.coefficients)
        weaker = replace(fit, coefficients=0.5 * fit.coefficients, effects=[(half,)] * 2)
        half_as_far = moved_by.of(weaker)
        assert half_as_far.last == pytest.approx(0.5 * far, rel=0.3)
        # The motion without it is kept for the next fit, and is another on another material.
        alone = Displacements(fitting.clips, fitting.start, 0.3).of(weaker)
        assert np.array_equal(half_as_far.frames, alone.frames)
        softer = replace(weaker, values=weaker.values - 0.5 * (np.arange(len(weaker.values)) == 0))
        alone = Displacements(fitting.clips, fitting.start, 0.3).of(softer)
        assert not np.array_equal(moved_by.of(softer).frames, half_as_far.frames)
        assert np.array_equal(moved_by.of(softer).frames, alone.frames)
        # Of several at once as of each.
        every = Displacements(fitting.clips, fitting.start, 0.3).of_all({"a": fit, "b": weaker, "c": softer})
        assert [one.last for one in every.values()] == [far, half_as_far.last, alone.last]
        nothing = replace(fit, coefficients=np.zeros_like(fit.coefficients))
        assert moved_by.of(nothing).last == 0.0
        assert moved_by.of(nothing).known == [0.0] * FRAMES

    def test_what_belongs_to_a_clip_may_act_in_a_later_one_alone(
        self, dragged: Problem, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """What is the cloth's acts in all clips, and the first says how far it moves that."""
        fit, fitting = dragged.drag, dragged.fitting
        moved_by = Displacements(fitting.clips, fitting.start, 0.3)
        (acting,) = fit.effects[1]
        nothing = acting_with(acting, np.zeros_like(fit.coefficients))
        later = replace(fit, effects=[(nothing,), (acting,)])
        assert moved_by.of(later).last == 0.0
        monkeypatch.setattr(type(acting), "SCOPE", Scope.CLIP)
        found = moved_by.of(later)
        assert not found.frames.any()
        # In its own wind.
        second = [clip(WINDS[1], effects)[0].tracked.positions for effects in ((acting,), ())]
        away = np.linalg.norm(second[0] - second[1], axis=-1)[2 * FRAMES // 3 :].mean() / 0.3
        assert found.last == pytest.approx(away, rel=0.4)

    def test_a_short_clip_is_simulated(self, dragged: Problem) -> None:
        fit, fitting = dragged.drag, dragged.fitting
        short = [replace(clip, windows=clip.windows[:1]) for clip in fitting.clips]
        assert short[0].windows[-1].last <= 8
        found = Displacements(short, fitting.start, 0.3).of(fit)
        assert 0.0 < found.last < np.inf

    def test_a_cloth_torn_apart_is_nowhere(self, dragged: Problem, monkeypatch: pytest.MonkeyPatch) -> None:
        """In the simulation, that is: diagnosis.json takes finite numbers alone."""
        fitting = dragged.fitting

        def blown_up(*_: object) -> WindowMotion:
            raise FloatingPointError

        monkeypatch.setattr(Shooting, "simulate", blown_up)
        found = Displacements(fitting.clips, fitting.start, 0.3).of(dragged.drag)
        assert found.last == np.inf
        assert found.known == []

    def test_no_effect_gains_where_none_acts(self, still: Problem) -> None:
        assert still.base.misfit - still.drag.misfit < still.drag.occam

    def test_the_cause_gains_most_and_is_as_large_as_it_was(self, dragged: Problem) -> None:
        rival = dragged.fitting.fitted((CATALOGUE["frame_rate"](),), dragged.base)
        gains = [dragged.base.misfit - fit.misfit - fit.occam for fit in (dragged.drag, rival)]
        assert gains[0] > gains[1] + 10
        acting = dragged.drag.effects[0][0]
        # Linear and normal resistance share what they do.
        total = float(acting.value("linear")) + 0.5 * float(acting.value("normal"))
        assert total == pytest.approx(DRAG, rel=0.35)
        assert (dragged.drag.coefficients >= 0).all()
        # Clips of one cloth have one drag.
        assert torch.equal(acting.values, dragged.drag.effects[1][0].values)

    def test_a_misfit_never_rises(self, dragged: Problem) -> None:
        assert (np.diff(dragged.drag.history) < 0).all()

    def test_a_full_step_that_gains_little_is_no_arrival(
        self, dragged: Problem, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """Where the quadratic promises more than a step keeps, a shorter one is taken."""
        fitting = dragged.fitting
        whole = fitting.fitted((drag(0.0),), dragged.base)
        steps: list[float] = []
        really = JointFitting._moved

        def disappointing(self: JointFitting, layout, place, shared, *rest):
            found = really(self, layout, place, shared, *rest)
            steps.append(float(np.linalg.norm(shared[: layout.n_base])))
            # The first full step, and the one back from there, end on a ledge just below where they began.
            return replace(place, misfit=place.misfit - 1e-3) if len(steps) <= 2 else found

        monkeypatch.setattr(JointFitting, "_moved", disappointing)
        other = fitting.fitted((drag(0.0),), dragged.base)
        assert steps[2] < steps[0]
        assert other.misfit == pytest.approx(whole.misfit, abs=2.0)
        assert dragged.base.misfit - other.misfit > 10

    def test_tangents_carried_nowhere_are_those_of_the_place(self, dragged: Problem) -> None:
        fitting, fit = dragged.fitting, dragged.drag
        layout = fitting.layout((drag(0.0),))
        here = fitting._evidence(layout, fit, ALONE)
        carried = fitting._carried(layout, fit, here)
        for before, after in zip(here.systems, carried.systems, strict=True):
            size = np.abs(before.gradient).max()
            assert after.gradient == pytest.approx(before.gradient, abs=1e-4 * size)
            assert (after.link is None) == (before.link is None)
            if before.link is not None and after.link is not None:
                assert np.array_equal(after.link.jump, before.link.jump)

    def test_more_steps_with_the_same_tangents_need_fewer_of_them(
        self, damped: tuple[JointFitting, JointFit, JointFit], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """They end where fits without them do."""
        usual, plain, _ = damped
        made: list[int] = []
        really = JointFitting._evidence
        monkeypatch.setattr(
            JointFitting,
            "_evidence",
            lambda self, *args, **more: made.append(1) or really(self, *args, **more),
        )
        found, needed = [], []
        for chords in (0, usual.settings.chords):
            settings = replace(usual.settings, chords=chords)
            fitting = JointFitting(usual.clips, usual.start, np.zeros(3), settings, usual.usual)
            made.clear()
            found.append(fitting.fitted(fitting.usual, plain).misfit)
            needed.append(len(made))
        assert needed[1] < needed[0]
        assert found[1] == pytest.approx(found[0], abs=1.0)

    def test_a_free_force_buys_what_the_effect_explains(self, dragged: Problem) -> None:
        clips = [joint_clip(*clip(WINDS[0], (drag(DRAG),)), FRAMES, forces=True)]
        loose = JointFitting(clips, 1.5 * STIFFNESS, np.zeros(3), JointFitSettings(force=1.6, outside=1.6))
        start = loose.start_fit()
        bought = loose.fitted((), start).misfit - loose.fitted((drag(0.0),), start).misfit
        assert bought < 0.3 * (dragged.base.misfit - dragged.drag.misfit)


def test_threads_that_gravity_does_not_stretch_get_no_stiffer(still: Problem) -> None:
    clips, start = still.fitting.clips, still.fitting.start
    cloth = clips[0].around.cloth
    share = float(cloth.masses.sum()) * 9.81 / (min(clips[0].around.cloth_size) * 2 * start[0])
    settings = JointFitSettings(inextensible=share)
    stiffer, softer = (
        JointFitting(clips, start, np.array([ratio, 0.0, 0.0]), settings).start_fit() for ratio in (9.0, -0.5)
    )
    assert stiffer.values[0] == pytest.approx(np.log(2.0))
    assert softer.values[0] == -0.5
    # A start that is stiffer still is no mistake.
    tight = JointFitting(clips, start, np.array([9.0, 0.0, 0.0]), JointFitSettings(inextensible=10 * share))
    assert tight.start_fit().values[0] == pytest.approx(0.0, abs=1e-9)


def test_ratios_of_the_law_stay_within_their_bounds() -> None:
    """Beyond 1 a ratio counts as 1: images say nothing there, and the prior would pull it over a cliff."""
    whole = np.array([STIFFNESS[0], 1.0, STIFFNESS[1], 1.0, STIFFNESS[2]])
    clips = [joint_clip(*clip(WINDS[0], (), taut_fitted, whole), FRAMES)]
    begin = whole * (1.2, 0.5, 1.2, 0.5, 1.2)
    fitting = JointFitting(clips, begin, np.array([0.0, 0.0, 0.0, 3.0, 0.0]))
    start = fitting.start_fit()
    highest = np.array([np.inf, np.log(2), np.inf, np.log(2), np.inf])
    assert start.values[3] == pytest.approx(np.log(2))
    found = fitting.fitted((), start)
    assert found.converged
    assert (found.values[:5] <= highest).all()
    assert begin[3] * np.exp(found.values[3]) == pytest.approx(1.0, abs=0.1)
    assert len(found.history) <= 9


class TestWrongClock:
    def test_a_wrong_clock_is_found_across_windows(self) -> None:
        """Ends are as fast in true time as the next starts in nominal time: no jump for the clock's sake."""
        log_factor = 0.1
        acting = CATALOGUE["frame_rate"]({"log_factor": log_factor})
        clips = [joint_clip(*clip(wind, (acting,)), FRAMES) for wind in WINDS]
        assert all(len(one.windows) > 1 for one in clips)
        fitting = JointFitting(clips, 1.5 * STIFFNESS, np.zeros(3))
        base = fitting.fitted((), fitting.start_fit())
        found = fitting.fitted((CATALOGUE["frame_rate"](),), base)
        assert found.misfit < 0.2 * base.misfit
        assert found.own[0] * acting.scales[0] == pytest.approx(log_factor, rel=0.1)


class TestCausesFromOutside:
    """Forces within the cloth are free: the law does not matter, what acts from outside does."""

    @staticmethod
    def free(*acting: Effect) -> tuple[JointFitting, Shooting, Surroundings]:
        """Fits to one clip with free forces within the cloth, and its problem."""
        shooting, around = clip(WINDS[0], acting)
        short = replace(
            shooting.settings,
            modes=3,
            window=1,
            force_knot=1,
            boundary=0.0003,
            jump_position=1e-4,
            jump_velocity=2e-3,
        )
        seen = softened(shooting.tracked, 0.3, FPS, 1.0, ModelError(0.003))
        problem = Shooting(
            shooting.simulator, SUBSTEPS, GRAVITY, HORIZONTAL, GRID, shooting.boundary, seen, short
        )
        freed = JointFitSettings(force=1.6, outside=0.002, passes=8)
        free = JointFitting([joint_clip(problem, around, FRAMES, forces=True)], STIFFNESS, np.zeros(3), freed)
        free.usual = (Hem(),)
        return free, problem, around

    def found(self, *acting: Effect) -> tuple[OutsideCauses, float]:
        """What is found, and what a density that varies gains in a fit under the law [nats]."""
        candidates = [CATALOGUE[name]() for name in OUTSIDE if name not in ("gusts", "gravity_tilt")]
        free, problem, around = self.free(*acting)
        base = free.fitted(free.usual, free.start_fit())
        bound = JointFitting([joint_clip(problem, around, FRAMES)], STIFFNESS, np.zeros(3))
        of_law = bound.fitted((), bound.start_fit())
        linear = bound.linearised(
            candidates, of_law, bound.quadratic(candidates, of_law, bound.systems(candidates, of_law))
        )
        return judged(free, base, 0.3, candidates), of_law.misfit - linear["nonuniform_density"].misfit

    @pytest.mark.parametrize(
        ("name", "values"),
        [
            ("air_drag", {"linear": 3 * DRAG}),
            ("nonuniform_density", {"mode_01": 0.6}),
        ],
    )
    def test_the_cause_leads_although_the_law_is_wrong(self, name: str, values: dict[str, float]) -> None:
        within = CATALOGUE["anisotropic_stiffness"]({"stretching": 1.0})
        causes = self.found(CATALOGUE[name](values), within)[0].causes
        nats = {one: cause.evidence.nats() for one, cause in causes.items()}
        assert max(nats, key=lambda one: nats[one]) == name
        assert nats[name] > 4
        assert causes[name].displacement.last > 0.01

    def test_fits_go_on_with_the_forces_that_another_one_has_found(self) -> None:
        free, _, _ = self.free(CATALOGUE["rest_curvature"]({"axis_0": 1.2e-3}))
        found = free.fitted(free.usual, free.start_fit())
        again = free.started_like(found)
        assert again.misfit < 0.8 * free.start_fit().misfit
        assert again.coefficients == pytest.approx(found.coefficients)
        # Starts and corners are those of the new motion.
        first = free.clips[0].shooting.layout(1)[1]
        for window, before in zip(again.windows[0], found.windows[0], strict=True):
            assert not window.standardised[:first].any()
            assert np.array_equal(window.standardised[first:], before.standardised[first:])

    def test_what_acts_within_leaves_no_trace(self) -> None:
        curled, uneven = {"axis_0": 1.2e-3}, {"stretching": 1.5, "bending": 1.5}
        within = CATALOGUE["rest_curvature"](curled), CATALOGUE["anisotropic_stiffness"](uneven)
        found, of_law = self.found(*within)
        assert max(cause.evidence.nats() for cause in found.causes.values()) < 3
        assert found.leading(lambda _: 3.0) is None
        # Under a law that knows nothing of it, a density that varies passes for it.
        assert of_law > 10


class TestLostStiffness:
    """A base model that lacks a moment makes up for it by bending without any resistance."""

    def test_it_is_noticed_for_what_works_against_it(
        self, curled: tuple[JointFitting, JointFit, Effect]
    ) -> None:
        fitting, soft, curvature = curled
        assert fitting.has_lost_its_stiffness(curvature, soft)
        assert not fitting.has_lost_its_stiffness(curvature, fitting.start_fit())
        assert not fitting.has_lost_its_stiffness(drag(0.0), soft)

    def test_the_hypothesis_finds_stiffness_and_moment(
        self, curled: tuple[JointFitting, JointFit, Effect]
    ) -> None:
        fitting, soft, curvature = curled
        from_there = fitting.fitted((curvature,), soft)
        found = fitting.fitted_hypothesis(curvature, soft)
        assert found.misfit < 0.1 * from_there.misfit
        assert found.values[2] == pytest.approx(0.0, abs=0.3)
        assert float(found.effects[0][0].value("axis_0")) == pytest.approx(CURL, rel=0.2)
        assert found.n_usual == 0
        assert len(found.own) == 2

    def test_what_is_known_beforehand_is_of_the_curvature(
        self, curled: tuple[JointFitting, JointFit, Effect]
    ) -> None:
        """The same moment is a usual curvature of a stiff cloth and an unusual one of a soft cloth."""
        fitting, soft, curvature = curled
        found = fitting.fitted_hypothesis(curvature, soft)
        bending = 2e-4 * np.exp(found.values[2])
        assert found.deviation == pytest.approx(5.0 * bending / 1e-3, rel=1e-6)
        softer = replace(found, deviation=0.01 * found.deviation)
        assert softer.evidence(soft).drop == found.evidence(soft).drop
        assert softer.evidence(soft).nats() < found.evidence(soft).nats() - 10

    def test_a_curvature_that_no_cloth_has_says_nothing(
        self, curled: tuple[JointFitting, JointFit, Effect]
    ) -> None:
        """A cloth without bending stiffness has no moment, however well one would fit."""
        fitting, soft, curvature = curled
        system = fitting.quadratic([curvature], soft, fitting.systems([curvature], soft))
        around = fitting.linearised([curvature], soft, system)["rest_curvature"]
        fits = [fitting.fitted_hypothesis(curvature, soft), around]
        for fit in fits:
            bending = 2e-4 * np.exp(fit.values[2])
            tightest = max(abs(float(m)) for m in fit.effects[0][0].values) / bending
            assert fit.possible == (tightest <= 200), tightest
        found, there = fits
        assert found.possible
        assert found.evidence(soft).nats() > 10
        assert not there.possible
        assert there.misfit < soft.misfit - 10
        assert there.evidence(soft).drop == 0
        assert there.evidence(soft).nats() < 0

    def test_a_fit_that_no_cloth_can_have_is_not_gone_on_with(
        self, curled: tuple[JointFitting, JointFit, Effect], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        fitting, soft, curvature = curled
        goes_on = fitting.fitted_hypothesis(curvature, soft)
        monkeypatch.setattr(RestCurvature, "is_possible", lambda self, material: False)
        given_up = fitting.fitted_hypothesis(curvature, soft)
        assert goes_on.evidence(soft).drop > 10
        assert given_up.history == soft.history
        assert given_up.misfit == soft.misfit
        assert given_up.names == (curvature.NAME,)
        assert given_up.evidence(soft).drop == 0
        assert given_up.evidence(soft).nats() == pytest.approx(0.0, abs=1e-9)

    def test_with_its_stiffness_it_must_explain_more_than_without(
        self, curled: tuple[JointFitting, JointFit, Effect]
    ) -> None:
        """From where it is lost a moment always explains a little: as a force that nothing resists."""
        fitting, soft, curvature = curled
        better = replace(soft, misfit=soft.misfit - 1e6)
        found = fitting.fitted_hypothesis(curvature, better)
        assert found.misfit == better.misfit
        assert not found.own.any()

    @pytest.mark.parametrize(("of_mode", "possible"), [(0.0, True), (0.9, False), (-0.9, False)])
    def test_the_tightest_place_counts(self, of_mode: float, possible: bool) -> None:
        curl = RestCurvature({"axis_1": 0.015, "axis_1_2": 0.015 * of_mode}, half_waves=2)
        assert curl.is_possible({"bending": 1e-4}) is possible
        assert curl.is_possible({"bending": 2e-4})


class TestUsualEffects:
    """What the base model has of itself is no evidence for others, and they are fitted beside it."""

    def test_the_base_model_has_as_much_of_them_as_clips_show(
        self, damped: tuple[JointFitting, JointFit, JointFit], still: Problem
    ) -> None:
        _, plain, usual = damped
        assert plain.misfit - usual.misfit > 10
        assert len(usual.own) == 2
        fitting = JointFitting(
            still.fitting.clips, still.fitting.start, np.zeros(3), usual=(CATALOGUE["internal_damping"](),)
        )
        assert still.base.misfit - fitting.fitted(fitting.usual, still.base).misfit < 2

    def test_other_effects_gain_nothing_from_them(
        self, damped: tuple[JointFitting, JointFit, JointFit]
    ) -> None:
        fitting, plain, usual = damped
        candidates = [drag(0.0), CATALOGUE["internal_damping"]()]
        gains = []
        for base in (plain, usual):
            found = fitting.linearised(
                candidates, base, fitting.quadratic(candidates, base, fitting.systems(candidates, base))
            )
            assert ("internal_damping" in found) is (base is plain)
            gains.append(base.misfit - found["air_drag"].misfit)
        assert gains[0] > 5 * max(gains[1], 1.0)

    def test_without_them_among_the_effects_the_base_model_is_another(
        self, damped: tuple[JointFitting, JointFit, JointFit]
    ) -> None:
        fitting, _, usual = damped
        alone = [drag(0.0)]
        with pytest.raises(ValueError, match="internal_damping"):
            fitting.linearised(alone, usual, fitting.quadratic(alone, usual, fitting.systems(alone, usual)))

    def test_a_hypothesis_keeps_their_coefficients_apart_from_its_own(
        self, damped: tuple[JointFitting, JointFit, JointFit]
    ) -> None:
        fitting, _, usual = damped
        effects = fitting.hypothesis(drag(0.0), usual)
        assert [effect.NAME for effect in effects] == ["internal_damping", "air_drag"]
        fit = fitting.fitted(effects, usual)
        assert fit.misfit <= usual.misfit
        assert (fit.n_usual, len(fit.own)) == (2, 3)
        assert fit.own_covariance == pytest.approx(fit.covariance[2:, 2:])
        candidates = [drag(0.0), CATALOGUE["internal_damping"]()]
        linear = fitting.linearised(
            candidates, usual, fitting.quadratic(candidates, usual, fitting.systems(candidates, usual))
        )["air_drag"]
        assert (linear.n_usual, linear.names) == (2, fit.names)
        assert linear.coefficients[:2] == pytest.approx(usual.coefficients)


class TestShortWindows:
    """Windows of a frame or two: nearly linear, so that fits arrive."""

    def test_a_frame_where_windows_meet_counts_once(self) -> None:
        shooting, around = clip(WINDS[0], ())
        one = joint_clip(shooting.with_window(2), around, FRAMES)
        frames = shooting.tracked.positions + np.linspace(0.001, 0.003, FRAMES)[:, None, None]
        sub = shooting.substeps
        moved = [
            replace(w, positions=np.repeat(frames[w.first : w.last + 1], sub, 0)[: -sub + 1])
            for w in one.windows
        ]
        once = sum(one.shooting.image_cost(window) for window in moved)
        assert once == pytest.approx(sum(shooting.tracked.cost(f, x) for f, x in enumerate(frames)))
        assert sum(shooting.image_cost(window) for window in moved) > 1.3 * once

    def test_its_gradient_is_that_of_what_counts(self) -> None:
        shooting, around = clip(WINDS[0], ())
        one = joint_clip(shooting.with_window(3), around, FRAMES)
        base = base_of(1.2 * STIFFNESS, np.array([0.0, 0.0, 0.0, *WINDS[0]]))
        window = one.shooting.simulate(one.windows[1], one.windows[1].standardised, base)
        shared = base_sensitivities(one.shooting, base)
        (known,) = one.shooting.known([window], base)
        _, gradient, _ = one.shooting.normal(window, known, shared, nothing_seen, 5)
        scales = local_scales(one.shooting, 3)
        for place in (0, one.shooting.n_fields + 1):
            step = np.zeros(len(window.standardised))
            step[place] = 1e-3
            costs = [
                one.shooting.image_cost(one.shooting.simulate(window, window.standardised + d, base))
                for d in (step, -step)
            ]
            slope = (costs[0] - costs[1]) / 2e-3
            assert slope == pytest.approx(scales[place] * gradient[5 + place], rel=0.03)

    def test_short_ones_arrive_where_long_ones_halt(self) -> None:
        shooting, around = clip(WINDS[0], ())
        found = {}
        for frames in (1, 12):
            jumps = np.sqrt(frames / 12)
            settings = replace(
                shooting.settings,
                window=frames,
                jump_position=jumps * shooting.settings.jump_position,
                jump_velocity=jumps * shooting.settings.jump_velocity,
            )
            other = shooting.with_window(frames)
            other.settings = settings
            fitting = JointFitting([joint_clip(other, around, FRAMES)], 20 * STIFFNESS, np.zeros(3))
            found[frames] = fitting.fitted((), fitting.start_fit())
        print({k: (v.misfit, v.values, len(v.history)) for k, v in found.items()})
        assert found[1].misfit < 0.5 * found[12].misfit

    def test_jumps_of_longer_windows_are_larger(self) -> None:
        settings = SessionSettings(window=0.04)
        assert settings.windows_at(50) == (2, pytest.approx(1.0))
        assert settings.windows_at(25) == (1, pytest.approx(1.0))
        assert settings.windows_at(12.5) == (1, pytest.approx(2**0.5))


def test_every_number_of_the_law_of_a_session_has_a_logarithm() -> None:
    cloth = grid_cloth((4, 3), (0.3, 0.4), 0.1, (), law=SessionSettings().law)
    values = cloth.material(stretching=850.0, shearing=1e-3, bending=5e-5).values[0]
    assert len(values) == 5
    assert (values > 0).all()


class TestSharedUnknowns:
    def test_every_scope_shares_its_coefficients(self) -> None:
        effects = [CATALOGUE[name]() for name in ("air_drag", "frame_rate", "gusts")]
        scopes = [effect.SCOPE for effect in effects]
        assert scopes == [Scope.CLOTH, Scope.DEVICE, Scope.CLIP]
        layout = SharedLayout(3, [0, 1, 0], effects)
        cloth, device, clips = zip(*(layout.coefficients(c) for c in range(3)), strict=True)
        assert np.array_equal(cloth[0], cloth[1])
        assert np.array_equal(device[0], device[2])
        assert not set(device[0]) & set(device[1])
        assert len(set(np.concatenate(clips))) == 3 * len(effects[2].scales)
        assert layout.n_coefficients == 3 + 2 + 3 * len(effects[2].scales)

    def test_every_clip_has_a_wind_of_its_own(self) -> None:
        layout = SharedLayout(3, [0, 0], ())
        assert layout.base(0).tolist() == [0, 1, 2, 3, 4]
        assert layout.base(1).tolist() == [0, 1, 2, 5, 6]


class TestGusts:
    """Harder on what faces them, or on all alike: the fit finds it."""

    @pytest.mark.parametrize("share", [0.0, 1.0])
    def test_the_share_that_only_pushes_what_faces_them_is_found(self, share: float) -> None:
        blowing = Gusts({"x_1": 2.5, "z_1": -3.0}).in_detail()
        values = blowing.values.clone()
        values[-1] = share - 0.5
        _, around = clip(WINDS[0], ())
        acting = blowing.with_values(values).in_clip(around)
        fitting = JointFitting([joint_clip(*clip(WINDS[0], (acting,)), FRAMES)], STIFFNESS, np.zeros(3))
        base = fitting.fitted((), fitting.start_fit())
        alike = fitting.fitted((Gusts(),), base)
        facing = fitting.fitted((Gusts().in_detail(),), base)
        found = 0.5 + facing.coefficients[-1] * float(facing.effects[0][-1].scales[-1])
        assert found == pytest.approx(share, abs=0.2)
        gained, rival = (fit.evidence(base).nats() for fit in (facing, alike))
        assert gained > rival + 5 if share else gained > rival - 5


def frames_of(windows: Sequence[WindowMotion], substeps: int) -> np.ndarray:
    """Positions of a fit in all frames (F, N, 3)."""
    return np.concatenate([windows[0].positions[:1], *(w.positions[substeps::substeps] for w in windows)])


class TestLeftOutClip:
    def test_the_cause_predicts_a_clip_that_it_has_not_seen(self, dragged: Problem) -> None:
        whole = dragged.fitting
        fewer = replace(whole.settings, passes=4)
        without = JointFitting(whole.clips[:-1], whole.start, np.zeros(3), fewer)
        fits, effects = {"air_drag": dragged.drag}, {"air_drag": drag(0.0)}
        found = left_out_shrinks(whole, without, dragged.base, fits, effects, 6, 2, 0)
        shrink = found.shrinks["air_drag"]
        assert shrink.estimate > 0.4
        assert shrink.best_placebo is not None
        assert shrink.best_placebo < shrink.estimate
        assert shrink.low <= shrink.estimate <= shrink.high
        assert shrink.held_out == "the last clip"

    def test_images_judge_and_not_a_motion_that_the_base_model_has_drawn_to_itself(
        self, dragged: Problem
    ) -> None:
        last = dragged.fitting.clips[-1]
        seen = last.shooting.tracked
        fitted = frames_of(dragged.base.windows[-1], last.shooting.substeps)
        drawn = seen.positions.copy()
        drawn[: len(fitted)] = fitted
        slopes = np.stack(
            [
                (information @ (x - truth).reshape(-1)).reshape(-1, 3)
                for information, x, truth in zip(seen.information, drawn, seen.positions, strict=True)
            ]
        )
        fits, effects = {"air_drag": dragged.drag}, {"air_drag": drag(0.0)}

        def shrink(gradient: np.ndarray) -> float:
            shooting = copy.copy(last.shooting)
            shooting.tracked = replace(seen, positions=drawn, gradient=gradient)
            clips = [*dragged.fitting.clips[:-1], replace(last, shooting=shooting)]
            whole = JointFitting(clips, dragged.fitting.start, np.zeros(3))
            found = left_out_shrinks(whole, None, dragged.base, fits, effects, 6, 0, 0)
            return found.shrinks["air_drag"].estimate

        # Where images know better than the motion they are linearised at, and where they do not.
        assert shrink(slopes) > shrink(np.zeros_like(slopes)) + 0.05

    def test_every_hypothesis_begins_with_the_motion_that_it_has_found(self, dragged: Problem) -> None:
        last = dragged.fitting.clips[-1]
        shooting, seen = copy.copy(last.shooting), last.shooting.tracked
        aside = np.zeros_like(seen.positions)
        aside[:, np.setdiff1d(np.arange(aside.shape[1]), last.around.cloth.pinned)] = 0.01
        slopes = np.stack(
            [(A @ x.reshape(-1)).reshape(-1, 3) for A, x in zip(seen.information, aside, strict=True)]
        )
        shooting.tracked = replace(seen, positions=seen.positions + aside, gradient=slopes)
        drawn = replace(last, shooting=shooting)
        whole = JointFitting([*dragged.fitting.clips[:-1], drawn], dragged.fitting.start, np.zeros(3))
        fits, effects = {"air_drag": dragged.drag}, {"air_drag": drag(0.0)}

        def refine(acting: tuple[Effect, ...], fit: JointFit) -> JointClip:
            return last if acting else drawn

        alike, own = (
            left_out_shrinks(whole, None, dragged.base, fits, effects, 6, 0, 0, how).shrinks["air_drag"]
            for how in (None, refine)
        )
        assert own.base == alike.base
        assert own.with_effect < 0.7 * alike.with_effect

        def failing(acting: tuple[Effect, ...], fit: JointFit) -> JointClip:
            if acting:
                raise FloatingPointError("a step fails")
            return drawn

        # Who cannot begin predicts nothing, and the others go on.
        assert left_out_shrinks(whole, None, dragged.base, fits, effects, 6, 0, 0, failing).shrinks == {}


class TestStarts:
    def test_fits_around_what_another_one_found_begin_near_their_end(self, still: Problem) -> None:
        clip = still.fitting.clips[0]
        windows = still.base.windows[0]
        shooting = copy.copy(clip.shooting)
        frames = frames_of(windows, shooting.substeps)
        shooting.tracked = replace(shooting.tracked, positions=frames)

        def misfit(**begin: Any) -> float:
            one = joint_clip(shooting, clip.around, FRAMES, **begin)
            return JointFitting([one], still.fitting.start, still.base.values[:3]).start_fit().misfit

        wind = tuple(still.base.values[3:5])
        near = misfit(velocities=fitted_velocities(clip.shooting, windows), wind=wind)
        assert near < 0.2 * misfit()

    @staticmethod
    def again(fitting: JointFitting, fit: JointFit) -> JointFitting:
        """Fits that begin where one has ended."""
        values = fit.values
        clips = [
            replace(
                clip,
                wind=tuple(values[3 + 2 * c : 5 + 2 * c]),
                windows=[
                    replace(begin, standardised=end.standardised)
                    for begin, end in zip(clip.windows, ended, strict=True)
                ],
            )
            for c, (clip, ended) in enumerate(zip(fitting.clips, fit.windows, strict=True))
        ]
        return JointFitting(clips, fitting.start, values[:3])

    def test_fits_of_the_same_motion_begin_where_another_one_has_ended(self, still: Problem) -> None:
        again = self.again(still.fitting, still.base).start_fit()
        assert again.misfit == pytest.approx(still.base.misfit, abs=0.01)

    def test_a_hypothesis_begins_where_it_has_ended(self, dragged: Problem) -> None:
        drags, found = self.again(dragged.fitting, dragged.drag), dragged.drag
        begin = drags.started((drag(0.0),), found.coefficients)
        assert begin.misfit == pytest.approx(found.misfit, abs=0.01)
        assert begin.names == found.names
        assert drags.start_fit().misfit > begin.misfit + 10


class TestAliases:
    def test_tilted_gravity_is_a_wind_and_leaves_no_trace(self, still: Problem) -> None:
        effects = [CATALOGUE[name]() for name in ("air_drag", "gravity_tilt", "frame_rate")]
        systems = still.fitting.systems(effects, still.base)
        quadratic = still.fitting.quadratic(effects, still.base, systems)
        found = session_alias(still.fitting, effects, quadratic, 10.0, 1.0)
        alias = found.alias
        limits = alias.detection_limits
        assert np.allclose(np.diag(alias.matrix), 1)
        assert limits["air_drag"] is not None
        assert limits["air_drag"] < DRAG
        # A wind of 2 m/s² a priori hides a tilt of several degrees.
        assert limits["gravity_tilt"] is None or limits["gravity_tilt"] > 5.0
        # The base model has a wind, so it is one answer with none, however usual such a wind is.
        assert found.unseen == ("gravity_tilt",)

    def test_in_still_air_a_tilt_shows(self, still: Problem) -> None:
        effects = [CATALOGUE["gravity_tilt"]()]
        quiet = copy.copy(still.fitting)
        calm = [replace(clip.around, still_air=True) for clip in quiet.clips]
        quiet.clips = [replace(c, around=there) for c, there in zip(quiet.clips, calm, strict=True)]
        quadratic = quiet.quadratic(effects, still.base, quiet.systems(effects, still.base))
        assert session_alias(quiet, effects, quadratic, 10.0, 1.0).unseen == ()


class TestSoftened:
    def test_smooth_errors_of_the_stated_size_cost_what_is_stated(self) -> None:
        shooting, _ = clip(WINDS[0], ())
        tracked = replace(shooting.tracked, information=[np.eye(3 * 36, dtype=np.float32) * 1e12] * FRAMES)
        error = ModelError(share=0.01, modes=9, frames=2.0)
        soft = softened(tracked, 0.3, 25.0, 1.0, error)
        moved = tracked.positions[3] + np.array([0.003, 0.0, 0.0])
        assert soft.cost(3, moved) == pytest.approx(0.5 * 9 / 2, rel=0.01)
        assert soft.cost(3, tracked.positions[3]) == 0.0

    def test_what_is_hidden_stays_hidden_and_the_rest_is_no_surer_than_both(self) -> None:
        shooting, _ = clip(WINDS[0], ())
        n = 3 * 36
        rng = np.random.default_rng(3)
        half = rng.standard_normal((n, n)) * 300.0
        # Nobody has seen the first ten coordinates.
        half[:10] = 0.0
        image = (half @ half.T).astype(np.float32)
        slope = np.concatenate((np.zeros(10), rng.standard_normal(n - 10)))
        tracked = replace(
            shooting.tracked,
            information=[image] * FRAMES,
            gradient=np.tile(slope.reshape(1, 36, 3), (FRAMES, 1, 1)),
        )
        soft = softened(tracked, 0.3, 25.0, 0.5, ModelError(share=0.01, modes=9, frames=2.0))
        variance = 0.003**2 * 36 / 9 * 2
        seen = 0.5 * image[10:, 10:].astype(np.float64)
        expected = np.linalg.inv(np.linalg.inv(seen) + variance * np.eye(n - 10))
        information = soft.information[2]
        found = as_array(information)
        np.testing.assert_allclose(soft.mean_information, found, atol=1e-6 * expected.max())
        assert soft.mean_information is soft.mean_information
        np.testing.assert_allclose(found[10:, 10:], expected, atol=1e-5 * expected.max())
        assert np.abs(found[:10]).max() <= 1e-8 * expected.max()
        right = rng.standard_normal((n, 5))
        for asked in (right, right[:, 0]):
            wanted = expected @ asked[10:]
            np.testing.assert_allclose((information @ asked)[10:], wanted, atol=1e-5 * np.abs(wanted).max())
            assert np.abs((information @ asked)[:10]).max() <= 1e-5 * np.abs(wanted).max()
        bent = expected @ np.linalg.solve(seen, 0.5 * slope[10:])
        np.testing.assert_allclose(soft.gradient[2].reshape(-1)[10:], bent, atol=1e-6 * np.abs(bent).max())

    def test_errors_cost_what_their_size_says_and_the_size_is_found(self) -> None:
        shooting, around = clip(WINDS[0], ())
        tracked = replace(shooting.tracked, information=[np.eye(3 * 36, dtype=np.float32) * 1e9] * FRAMES)
        error = ModelError(share=0.003, modes=4, frames=1.0)
        shooting.tracked = softened(tracked, 0.3, 25.0, 1.0, error)
        windows = joint_clip(shooting.with_window(2), around, FRAMES).windows
        rng = np.random.default_rng(5)
        fields = cosine_modes(GridLines.even(*GRID), 2)
        for factor in (1.0, 2.0):
            deviation = factor * 0.003 * 0.3 / np.sqrt(len(fields))
            drawn = deviation * rng.standard_normal((40, FRAMES, len(fields), 3))
            found = []
            for one in np.einsum("rfkc,kn->rfnc", drawn, fields):
                frames = np.repeat(tracked.positions + one, SUBSTEPS, 0)
                moved = [
                    replace(w, positions=frames[w.first * SUBSTEPS : w.last * SUBSTEPS + 1]) for w in windows
                ]
                found.append(model_errors(shooting, moved, 0.3, error))
            total = ModelErrors.of_all(found)
            assert total.cost / total.expected == pytest.approx(factor**2, rel=0.1)
            assert total.found == pytest.approx(factor * 0.003, rel=0.05)

    def test_what_images_do_not_see_stays_unseen(self) -> None:
        shooting, _ = clip(WINDS[0], ())
        seen = np.zeros((108, 108), np.float32)
        seen[0, 0] = 1e4
        tracked = replace(shooting.tracked, information=[seen] * FRAMES)
        soft = softened(tracked, 0.3, 25.0, 0.5)
        away = np.zeros((36, 3))
        away[5] = 0.1
        assert soft.cost(2, tracked.positions[2] + away) == pytest.approx(0.0, abs=1e-9)
        away = np.zeros((36, 3))
        away[0, 0] = 1e-3
        assert 0 < soft.cost(2, tracked.positions[2] + away) < 0.5 * 0.5 * 1e4 * 1e-6


class TestUnknownObstacles:
    """Contact with something that nobody knows of."""

    WIND = (0.3, -1.5)
    NORMAL = np.array([0.1, 0.1, 1.0]) / np.linalg.norm([0.1, 0.1, 1.0])

    def fitting(self, *acting: Effect) -> tuple[JointFitting, JointFit]:
        """Fits to a cloth that a wind drives, in short windows, and the base model's."""
        shooting, around = clip(self.WIND, acting)
        short = replace(shooting.settings, window=1, jump_position=1e-4, jump_velocity=2e-3)
        problem = Shooting(
            shooting.simulator,
            SUBSTEPS,
            GRAVITY,
            HORIZONTAL,
            GRID,
            shooting.boundary,
            shooting.tracked,
            short,
        )
        fitting = JointFitting([joint_clip(problem, around, FRAMES)], 1.5 * STIFFNESS, np.zeros(3))
        return fitting, fitting.fitted((), fitting.start_fit())

    def obstacle(self) -> Contact:
        """In the way of the last third of the motion."""
        free = clip(self.WIND, ())[0].tracked.positions
        point = [0.1, 0.3, float(free[..., 2].min()) + 0.06]
        return Contact(Plane(point, self.NORMAL.tolist()), {"stiffness": 2e4, "friction": 0.3})

    def gain(self, fitting: JointFitting, base: JointFit, own: list[dict[str, Effect]]) -> JointFit:
        """The fit with contact, with what may be touched in the clips."""
        fitting.clips = [replace(c, own=there) for c, there in zip(fitting.clips, own, strict=True)]
        return fitting.fitted((Contact(),), base)

    def test_the_plane_is_found_and_explains_more_than_gusts(self) -> None:
        fitting, base = self.fitting(self.obstacle())
        found = touching(fitting, base)
        own = found.of_clips
        store = ValueStore((TouchedObstacles,), (Contact(),))
        kept = store.value(store.flat(found)).of_clips
        np.testing.assert_equal(kept[0]["contact"].place(), own[0]["contact"].place())
        # Where the cloth is stopped it faces the way that the true one does.
        met = torch.from_numpy(fitting.clips[0].shooting.tracked.positions.reshape(-1, 3))
        met = met[self.obstacle()._obstacle.distance(met, met) < 0.003]
        facing = own[0]["contact"]._obstacle.normals(met).numpy() @ self.NORMAL
        assert len(facing) > 2
        assert facing.min() > np.cos(np.radians(30))
        fit = self.gain(fitting, base, own)
        gained = base.misfit - fit.misfit
        gusts = base.misfit - fitting.fitted((CATALOGUE["gusts"](),), base).misfit
        assert gained > 2 * gusts > 0
        assert fit.own[0] > 0
        # What was touched is kept with the fit.
        kinds = (JointFit, WindowMotion, State)
        store = ValueStore(kinds, (Contact(),))
        again = store.value(store.flat(fit))
        np.testing.assert_equal(again.effects[0][0].place(), own[0]["contact"].place())
        at = torch.from_numpy(fitting.clips[0].windows[0].positions[-1])
        there = (own[0]["contact"], again.effects[0][0])
        distances = [effect._obstacle.distance(at, at) for effect in there]
        assert torch.equal(*distances)
        assert again.effects[0][0]._thickness == own[0]["contact"]._thickness > 0

    def test_where_nothing_is_touched_a_plane_explains_next_to_nothing(self) -> None:
        fitting, base = self.fitting()
        own = touching(fitting, base).of_clips
        fit = self.gain(fitting, base, own) if any(own) else base
        assert base.misfit - fit.misfit < 6

    def test_beside_free_forces_its_push_has_a_history(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """What the cloth asks of an obstacle is not as deep as it is seen within: a law alone says that."""
        reached = clip(WINDS[0], ())[0].tracked.positions[..., 2].min()
        wall = Plane([0.1, 0.3, float(reached) + 0.06], self.NORMAL.tolist())
        acting = Contact(wall, {"stiffness": 2e4, "friction": 0.3})
        free, _, around = TestCausesFromOutside.free(acting)
        base = free.fitted(free.usual, free.start_fit())
        free = free.with_own([{"contact": Contact(wall, thickness=0.006)}])
        found = judged(free, base, 0.3, (Contact(),)).causes["contact"]
        assert len(found.coefficients) == len(Contact().pushing(12 / around.fps).parameters)
        monkeypatch.setattr(outside_causes, "_with_pushes", lambda *given: given)
        constant = judged(free, base, 0.3, (Contact(),)).causes["contact"]
        assert len(constant.coefficients) == len(Contact.PARAMETERS)
        assert found.evidence.nats() > 1.2 * constant.evidence.nats() > 50

    def test_contact_acts_in_the_clips_that_have_an_obstacle(self) -> None:
        free = joint_clip(*clip(WINDS[0], ()), FRAMES)
        wall = Contact(Plane([0.0, 0.0, 0.9], [0.0, 0.0, 1.0]), thickness=0.01)
        fitting = JointFitting([free, replace(free, own={"contact": wall})], STIFFNESS, np.zeros(3))
        layout = fitting.layout((Contact(),))
        assert layout.n_coefficients == 4
        fit = fitting.started((Contact(),), np.array([1.0, 0.0, 1.0, 0.0]))
        assert [bool(acting[0].place()) for acting in fit.effects] == [False, True]
        without = fitting.start_fit()
        for clip_, moved in ((0, False), (1, True)):
            pairs = zip(fit.windows[clip_], without.windows[clip_], strict=True)
            away = max(float(np.abs(a.positions - b.positions).max()) for a, b in pairs)
            assert (away > 1e-3) == moved


class TestSwept:
    """What a motion comes up to and never enters."""

    def test_planes_are_those_that_many_vertices_come_close_to(self) -> None:
        rng = np.random.default_rng(0)
        frames = rng.uniform(-0.2, 0.2, (20, 50, 3))
        # A wall at x = 0.1, which half of the vertices lie against from frame 5 on.
        frames[..., 0] = np.minimum(frames[..., 0], 0.05)
        frames[5:, :25, 0] = 0.1 - 0.0005 * rng.random((15, 25))
        plane = Swept(frames, 0.3).planes(0.006)[0]
        np.testing.assert_allclose(plane.normal, [-1.0, 0.0, 0.0], atol=0.1)
        flat = torch.from_numpy(frames.reshape(-1, 3))
        assert float(plane.distance(flat, flat).min()) > -1e-12
        beside = Swept(frames, 0.3).beside(Met(plane), 0.1)
        assert len(beside) == 2 * 9
        turned = [float(one.touched.normal @ plane.normal) for one in beside if not one.inside]
        np.testing.assert_allclose(turned, [1.0, *[np.cos(0.1)] * 8])
        assert sorted({one.inside for one in beside}) == pytest.approx([0.0, 0.25 * 0.1 * 0.3])
        # What lies against something from the first frame on has been there before.
        frames[:, :25] = frames[5, :25]
        assert all(float(one.normal[0]) > -0.9 for one in Swept(frames, 0.3).planes(0.006)[:3])

    def test_a_ball_that_the_cloth_is_laid_over_is_among_them(self) -> None:
        i, j = np.meshgrid(np.linspace(-0.25, 0.25, 21), np.linspace(-0.25, 0.25, 21), indexing="ij")
        radius, centre = 0.12, np.array([0.02, 0.01, 1.0])
        over = np.sqrt(np.clip(radius**2 - (i - centre[0]) ** 2 - (j - centre[1]) ** 2, 0.0, None))
        frames = []
        for height in np.linspace(0.3, 0.02, 15):
            z = np.maximum(np.where(over > 0, over, -1.0), height)
            frames.append(np.stack((i, j, centre[2] + z), -1).reshape(-1, 3))
        swept = Swept(np.array(frames), 0.5)
        balls = swept.balls(0.01)
        away = [np.linalg.norm(ball.centre.numpy() - centre) for ball in balls[:10]]
        assert min(away) < 0.04
        nearest = balls[int(np.argmin(away))]
        assert nearest.radius == pytest.approx(radius, abs=0.04)
        flat = torch.from_numpy(np.array(frames).reshape(-1, 3))
        assert all(float(ball.distance(flat, flat).min()) > -1e-12 for ball in balls)
        beside = swept.beside(Met(nearest, 0.01), 0.03)
        assert len(beside) == 3 * 27
        assert all(isinstance(one.touched, Sphere) for one in beside)

    def test_an_obstacle_may_be_larger_than_the_motion_lets_it_be(self) -> None:
        at = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
        for touched in (Sphere([0.0, 0.0, 0.5], 0.5), Plane([3.0, 1.0, 1.0], [0.0, 0.0, 2.0])):
            assert float(Met(touched).obstacle.distance(at, at)) == pytest.approx(0.0, abs=1e-12)
            assert float(Met(touched, 0.02).obstacle.distance(at, at)) == pytest.approx(-0.02)
            assert torch.equal(Met(touched, 0.02).obstacle.normals(at), touched.normals(at))

    def test_obstacles_are_met_however_closeness_is_counted_and_each_once(self) -> None:
        x = clip(WINDS[0], ())[0].tracked.positions
        swept = Swept(x, 0.3)
        met = swept.met()
        places = [tuple(np.concatenate([*Contact(one.obstacle).place().values()])) for one in met]
        assert len(set(places)) == len(places)
        touched = {repr(Contact(one.touched).place()) for one in met}
        for within in (0.02, 0.04, 0.06):
            near = [*swept.planes(within * 0.3), *swept.balls(within * 0.3)]
            assert touched.issuperset(repr(Contact(one).place()) for one in near)
        assert sorted({one.inside for one in met}) == pytest.approx([0.0, 0.03 * 0.3])

    def test_pushes_are_what_differentiation_says(self) -> None:
        shooting, around = clip(WINDS[0], ())
        x = shooting.tracked.positions
        obstacles = [*Swept(x, 0.3).planes(0.006)[:3], *Swept(x, 0.3).balls(0.006)[:3]]
        pushes = _Pushes(obstacles, 0.2)
        at = torch.from_numpy(x[-1])
        now = StepContext(
            cloth=around.cloth,
            material=Material(around.cloth.energies.parameters, torch.from_numpy(STIFFNESS)[None]),
            positions=at,
            velocities=torch.zeros_like(at),
            time=0.0,
            time_step=0.01,
            boundary=at[around.cloth.pinned],
        )
        for k, forces in enumerate(pushes.force_derivatives(at, now)):
            y = at.clone().requires_grad_()
            one = pushes.with_values(torch.eye(len(obstacles), dtype=torch.float64)[k])
            (gradient,) = torch.autograd.grad(one.energy(y, now).sum(), y)
            torch.testing.assert_close(forces, -gradient)
            assert float(forces.norm()) > 0
