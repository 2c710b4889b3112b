"""Effects on a skirt: bodies, answers, and clips that are told what they lack."""

from __future__ import annotations

import numpy as np
import pytest

from toile.diagnosis.garment.diagnosis import diagnose
from toile.diagnosis.garment.effects import EFFECTS
from toile.diagnosis.garment.error_model import ErrorModel
from toile.diagnosis.garment.fit import ClipFitting, FitSettings
from toile.diagnosis.garment.scene import Scene
from toile.diagnosis.garment.verdict import AMBIGUOUS, NONE, DecisionWeights

SETTINGS = FitSettings(simulated=2, roll_outs=2)
WEIGHTS = DecisionWeights(threshold=1.0, temperature=1.0)


def fitting_of(stage, observed) -> ClipFitting:
    return ClipFitting(stage.look, Scene(), stage.responses, observed, stage.errors, stage.form, SETTINGS)


def test_a_body_of_vertices_errs_as_one_of_poses_does(tiny_stage) -> None:
    right = tiny_stage.posed.moved(0.0, 0.0)
    for thigh, girth in ((0.05, 0.0), (0.0, 0.004)):
        wrong = tiny_stage.posed.moved(thigh, girth)
        tracked = tiny_stage.look.body.moved(thigh, girth)
        moved = (wrong - right).norm(dim=-1)
        assert float((tracked - wrong).norm(dim=-1).mean()) < 0.02 * float(moved.mean())
    assert float((tiny_stage.look.body.moved(0.0, 0.0) - right).abs().max()) < 1e-12


def test_an_answer_foretells_a_step_of_another_size(tiny_stage) -> None:
    masks = tiny_stage.form(tiny_stage.look(EFFECTS["waist_slip"].changed(Scene(), 2.0)).masks)
    step = (masks - tiny_stage.responses.base).ravel()
    foretold = 2.0 * tiny_stage.responses.answers["waist_slip"].ravel()
    assert np.linalg.norm(step - foretold) < 0.5 * np.linalg.norm(step)


@pytest.mark.parametrize(("name", "coefficient"), [("mask_bias", 1.5), ("waist_slip", 3.0)])
def test_a_clip_is_told_what_it_lacks(tiny_stage, name: str, coefficient: float) -> None:
    """Masks half a pixel and more too wide, a waistband 24 mm low."""
    observed = tiny_stage.with_effect(name, coefficient)
    found = diagnose(fitting_of(tiny_stage, observed), WEIGHTS)
    assert found.verdict.candidates[0] == name, found.verdict.probabilities
    fit = found.fits.fits[name]
    assert coefficient / 1.6 < fit.coefficient < 1.6 * coefficient
    assert found.shrinkage.effect == name
    assert found.shrinkage.share > max(0.1, found.shrinkage.placebo)
    assert found.shrinkage.wrong_sign > found.shrinkage.without


def test_twice_the_stiffness_is_found_where_the_mesh_is_right(tiny_stage) -> None:
    """On another mesh a third of a second is not enough for it; here the masks are the model's own."""
    scene = EFFECTS["garment_stiffness"].changed(Scene(), 10 / 3)
    observed = tiny_stage.form(tiny_stage.look(scene).masks)
    moved = float(np.mean(np.square(observed - tiny_stage.responses.base)))
    errors = ErrorModel(1e-2 * moved, 1e-2 * moved, dict.fromkeys(EFFECTS, 1e-3), 1)
    found = ClipFitting(
        tiny_stage.look, Scene(), tiny_stage.responses, observed, errors, tiny_stage.form, SETTINGS
    ).fit()
    assert found.best.effect == "garment_stiffness"
    assert found.best.simulated > 0
    assert (10 / 3) / 1.6 < found.best.coefficient < 1.6 * (10 / 3)


def test_a_null_names_nothing_and_twice_is_the_same(tiny_stage) -> None:
    observed = tiny_stage.observed(Scene())
    first, again = (diagnose(fitting_of(tiny_stage, observed), WEIGHTS) for _ in range(2))
    assert first.verdict.answer in (NONE, AMBIGUOUS)
    assert first.verdict.probabilities[NONE] > 0.1
    assert first.to_dict() == again.to_dict()
