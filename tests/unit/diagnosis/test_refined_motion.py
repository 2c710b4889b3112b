"""Rounds that refine a tracked motion: by errors as they are found, until it stays where it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

import toile.diagnosis.problem as problems
import toile.diagnosis.session_stages as stages
from toile.diagnosis.model_grid import spline_matrix
from toile.diagnosis.problem import DiagnosisProblem
from toile.diagnosis.session_settings import RefiningSettings, SessionSettings
from toile.diagnosis.session_stages import RefinedMotion, SessionModel, refined_motion, with_error_found
from toile.diagnosis.stored_values import ValueStore
from toile.workers import ALONE

WIDTH = 0.5
TRUE = np.zeros((4, 9, 3))
TRACKED = TRUE + 0.02
SETTINGS = SessionSettings(
    error_rounds=0, side=9, refining=RefiningSettings(side=6, rounds=7, firm=0, finer=0)
)
GRIDS = {side: SimpleNamespace(side=side) for side in (6, 9)}


@dataclass(frozen=True)
class _Clip:
    tracked: Any
    n_frames: int
    still_air: bool


class _Rounds:
    """A base model that takes the share of the error away that its own errors let images have.

    Args:
        found: errors of the model, round by round [widths].
    """

    def __init__(self, found: Sequence[float]) -> None:
        self.found = list(found)
        self.thought: list[float | None] = []
        self.asked: list[SessionSettings] = []
        self.began: list[int | None] = []
        self.still: list[bool] = []

    def _refined(self, details: RefinedMotion | None, settings: SessionSettings) -> None:
        # The whole model's motion has no details that it cannot have.
        assert (details is not None) == (settings.side < SETTINGS.side)

    def __call__(self, clips: Any, motion: RefinedMotion, settings: SessionSettings, stiffness: Any) -> Any:
        # A tilt of gravity or gusts push the cloth where no wind blows, and the base model has neither.
        self.still += [clip.still_air for clip in clips]
        self.thought.append(motion.error)
        self.asked.append(settings)
        self.began.append(None if motion.velocities is None else int(motion.velocities[0][0, 0, 0]))
        kept = 0.7 if motion.error is None or motion.error > 0.001 else 0.1
        position = TRUE + kept * (motion.positions[0] - TRUE)
        error = self.found[len(self.thought) - 1]
        return SimpleNamespace(
            fitting=SimpleNamespace(start_fit=lambda workers: None, fitted=lambda *given: None),
            errors=lambda fit: SimpleNamespace(found=error),
            refined=lambda fit, details: (
                self._refined(details, settings)
                or RefinedMotion([position], None, velocities=[np.full((4, 9, 3), settings.side)])
            ),
            width=WIDTH,
        )


def _moved(motion: RefinedMotion, before: Any, grids: Any) -> RefinedMotion:
    if motion.velocities is None:
        return motion
    assert motion.velocities[0][0, 0, 0] == before[0].side
    return replace(motion, velocities=[np.full((4, 9, 3), grid.side) for grid in grids])


def rounds(monkeypatch: pytest.MonkeyPatch, found: Sequence[float], settings: SessionSettings) -> Any:
    model = _Rounds(found)
    monkeypatch.setattr(stages, "SessionModel", model)
    monkeypatch.setattr(stages, "_grid", lambda clip, settings: GRIDS[settings.side])
    monkeypatch.setattr(stages, "on_other_grids", _moved)
    clip: Any = _Clip(SimpleNamespace(positions=TRACKED), len(TRACKED), still_air=True)
    return model, refined_motion([clip], settings, (850.0, 0.5, 0.005), ALONE)


def test_what_the_model_is_wrong_by_is_found_on_the_way(monkeypatch: pytest.MonkeyPatch) -> None:
    model, motion = rounds(monkeypatch, [0.0012, 0.0006, 0.0005, 0.0005, 0.0005, 0.0005, 0.0005], SETTINGS)
    assert not any(model.still)
    assert model.thought[:3] == [None, 0.0012, 0.0006]
    assert np.abs(motion.positions[0] - TRUE).max() < 0.0005 * WIDTH


def test_rounds_end_where_the_motion_changes_by_less_than_the_model_is_wrong_by(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    right, _ = rounds(monkeypatch, [0.0005] * 7, SETTINGS)
    assert len(right.thought) < 7
    never = replace(SETTINGS, refining=replace(SETTINGS.refining, steady=0.0))
    every, _ = rounds(monkeypatch, [0.0005] * 7, never)
    assert len(every.thought) == 7
    # A model that is wrong by more than the motion changes cannot make it better.
    wrong, _ = rounds(monkeypatch, [0.02] * 7, SETTINGS)
    assert len(wrong.thought) == 2


def test_coarse_rounds_come_first_then_a_firm_one_and_the_whole_model(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    every = replace(SETTINGS, refining=RefiningSettings(side=6, rounds=3, firm=5, finer=2, steady=0.0))
    model, motion = rounds(monkeypatch, [0.0005] * 6, every)
    assert [asked.side for asked in model.asked] == [6, 6, 6, 6, 9, 9]
    loose, jump = every.refining.jumps * every.jump_position, every.jump_position
    assert [asked.jump_position for asked in model.asked] == [loose] * 3 + [jump] + [loose] * 2
    assert [asked.fit.passes for asked in model.asked] == [2, 2, 2, 5, 2, 2]
    # As many modes as refining asks for, where the grid has vertices for them, and never fewer than else.
    assert [asked.modes for asked in model.asked] == [4] * 4 + [6] * 2
    few = replace(every, modes=5, refining=replace(every.refining, modes=3))
    assert {asked.modes for asked in rounds(monkeypatch, [0.0005] * 6, few)[0].asked} == {5}
    # Velocities are of the grid on which a round begins, the last ones of that of the comparison.
    assert model.began == [None, 6, 6, 6, 9, 9]
    assert motion.velocities[0][0, 0, 0] == 9
    coarse = replace(every, refining=replace(every.refining, finer=0))
    model, motion = rounds(monkeypatch, [0.0005] * 4, coarse)
    assert [asked.side for asked in model.asked] == [6] * 4
    assert motion.velocities[0][0, 0, 0] == 9
    # A model that is as coarse already has no finer one.
    small = replace(every, refining=replace(every.refining, side=20))
    model, _ = rounds(monkeypatch, [0.0005] * 6, small)
    assert [asked.side for asked in model.asked] == [9] * 6


def test_images_are_looked_at_anew_only_where_the_motion_or_the_grid_is_another(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    looked = []

    def tracked_motion(reconstruction: Any, positions: np.ndarray, grid: Any, term: Any) -> Any:
        looked.append((positions.copy(), grid))
        return SimpleNamespace(positions=positions.copy())

    monkeypatch.setattr(problems, "tracked_motion", tracked_motion)
    problem = DiagnosisProblem.__new__(DiagnosisProblem)
    problem.reconstruction, problem.image_term, problem._images = None, lambda: None, None  # type: ignore
    grids: Any = [SimpleNamespace(prolong=np.eye(n)) for n in (9, 4)]
    positions = TRACKED.copy()
    first = problem.images_around(positions, grids[0])
    assert problem.images_around(TRACKED.copy(), grids[0]) is first
    # The caller's array is the caller's: what is done to it later is another motion.
    positions += 0.001
    assert problem.images_around(positions, grids[0]) is not first
    assert problem.images_around(positions, grids[1]).positions is not None
    assert problem.images_around(positions[:2], grids[1]).positions.shape == (2, 9, 3)
    assert len(looked) == 4


def test_what_a_coarse_grid_cannot_have_of_a_motion_stays() -> None:
    fine, coarse = 9, 5
    to_fine = spline_matrix(np.linspace(0, 1, coarse), np.linspace(0, 1, fine))
    to_coarse = spline_matrix(np.linspace(0, 1, fine), np.linspace(0, 1, coarse))
    rng = np.random.default_rng(0)
    smooth = np.einsum("vn,fnc->fvc", to_fine, rng.standard_normal((4, coarse, 3)))
    creased = smooth + 0.01 * np.sin(3 * np.pi * np.linspace(0, 1, fine))[None, :, None]
    moved = np.einsum("vn,fnc->fvc", to_fine, rng.standard_normal((4, coarse, 3)))
    positions = np.einsum("nv,fvc->fnc", to_coarse, creased + moved)
    model: Any = SimpleNamespace(
        grids=[SimpleNamespace(prolong=to_fine, restrict=to_coarse)],
        fitting=SimpleNamespace(clips=[SimpleNamespace(shooting=SimpleNamespace(substeps=1))]),
    )
    windows = [SimpleNamespace(positions=positions[k : k + 2], start=None, last=k + 1) for k in range(3)]
    fit: Any = SimpleNamespace(windows=[windows], values=None)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stages, "fitted_velocities", lambda shooting, windows: np.zeros((4, coarse, 3)))
        with_details = SessionModel.refined(model, fit, RefinedMotion([creased], None))
        without = SessionModel.refined(model, fit)
    np.testing.assert_allclose(with_details.positions[0], creased + moved, atol=1e-12)
    assert np.abs(without.positions[0] - (creased + moved)).max() > 0.002


def test_a_shorter_last_window_keeps_its_own_unknowns(monkeypatch: pytest.MonkeyPatch) -> None:
    """Windows longer than the knots of the corners' paths have fewer of them where the clip ends."""
    windows = [SimpleNamespace(standardised=np.full(n, float(n))) for n in (9, 9, 6)]
    base = SimpleNamespace(values=np.zeros(5), windows=[windows])
    fitting = SimpleNamespace(start_fit=lambda workers: None, fitted=lambda *given: base)
    model = SimpleNamespace(fitting=fitting, errors=lambda fit: SimpleNamespace(found=0.001))
    monkeypatch.setattr(stages, "SessionModel", lambda *given: model)
    motion = RefinedMotion([TRUE], None)
    found = with_error_found([], motion, replace(SETTINGS, error_rounds=1), (850.0, 0.5, 0.005), ALONE)
    assert found.unknowns is not None
    assert [len(own) for own in found.unknowns[0]] == [9, 9, 6]
    # It goes through the store as it is.
    store = ValueStore((RefinedMotion,))
    again = store.value(store.flat(found))
    for own, kept in zip(again.unknowns[0], found.unknowns[0], strict=True):
        np.testing.assert_array_equal(own, kept)


def test_what_is_held_stays_where_it_was_found_across_and_where_the_template_has_it_in_depth() -> None:
    template = np.array([[-0.3, 0.0, 1.2], [0.0, 0.0, 1.2], [0.3, 0.1, 1.1]])
    scene: Any = SimpleNamespace(pinned_vertices=(0, 2), template=torch.from_numpy(template).float())
    template = scene.template.numpy().astype(np.float64)
    ray = template / np.linalg.norm(template, axis=-1, keepdims=True)
    aside = np.cross(ray, [0.0, 1.0, 0.0])
    # Everywhere 4 mm beside the template, and in one frame of three 20 mm; ever deeper.
    away = np.array([0.004, 0.004, 0.02])[:, None, None] * aside
    motion = template + np.array([0.01, 0.02, 0.03])[:, None, None] * ray + away
    before = motion.copy()
    found = stages._held(scene, motion)
    assert np.array_equal(motion, before)
    # What is free is where it was found.
    assert np.array_equal(found[:, 1], motion[:, 1])
    held = np.repeat((template + 0.004 * aside)[None], 3, 0)
    np.testing.assert_allclose(found[:, [0, 2]], held[:, [0, 2]], atol=1e-12)


def test_rounds_without_holding_begin_with_the_refined_motion_and_its_errors(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    settings = replace(SETTINGS, refining=replace(SETTINGS.refining, loose=2))
    model = _Rounds([0.0005] * 2)
    monkeypatch.setattr(stages, "SessionModel", model)
    monkeypatch.setattr(stages, "_grid", lambda clip, settings: GRIDS[settings.side])
    monkeypatch.setattr(stages, "on_other_grids", _moved)
    begin = RefinedMotion([TRACKED], None, error=0.0007, velocities=[np.full((4, 9, 3), 9)])
    clip: Any = _Clip(None, len(TRACKED), still_air=True)
    found = stages.loosened([clip], begin, settings, (850.0, 0.5, 0.005))
    assert model.thought == [0.0007] * 2
    assert model.began == [6, 6]
    assert [asked.held for asked in model.asked] == [settings.boundary] * 2
    assert model.still == [False] * 2
    assert settings.held < settings.boundary
    assert np.abs(found.positions[0] - TRUE).max() < 0.5 * np.abs(TRACKED - TRUE).max()
