"""Two effects that move the cloth at once are both found, and one is not taken for two."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from tests.unit.diagnosis import test_joint_fit
from tests.unit.diagnosis.test_joint_fit import DRAG, FRAMES, STIFFNESS, WINDS, clip, drag
from toile.diagnosis.decision import NONE
from toile.diagnosis.joint_fit import JointFit, JointFitting, joint_clip
from toile.diagnosis.model_errors import ModelErrors
from toile.diagnosis.outside_causes import OutsideCauses
from toile.diagnosis.pipeline import Pipeline, PipelineStage
from toile.diagnosis.record import AMBIGUOUS, Shrink, Verdict
from toile.diagnosis.results import KINDS
from toile.diagnosis.second_effect import EffectsBeside, Foretold, SecondEffect
from toile.diagnosis.session_stages import HypothesisStages, RefinedMotion
from toile.diagnosis.session_weights import SessionWeights
from toile.diagnosis.stage_store import StageStore
from toile.diagnosis.stage_times import StageTimes
from toile.diagnosis.stored_values import ValueStore
from toile.diagnosis.verdict import VerdictSettings, of_two
from toile.effects.base import Effect
from toile.effects.catalogue import CATALOGUE

CANDIDATES = tuple(CATALOGUE[n]() for n in ("air_drag", "anisotropic_stiffness", "nonuniform_density"))
UNEVEN = CATALOGUE["anisotropic_stiffness"]({"stretching": 1.5, "bending": 1.5})
SETTINGS = VerdictSettings(named=0.9)


def fitted(*acting: Effect) -> tuple[JointFitting, JointFit]:
    clips = [joint_clip(*clip(wind, acting), FRAMES) for wind in WINDS[:1]]
    fitting = JointFitting(clips, STIFFNESS, np.zeros(3))
    return fitting, fitting.fitted((), fitting.start_fit())


def second(folder: Path, *acting: Effect, foretold: Foretold | None = None) -> SecondEffect:
    """What is found in clips with these effects, by the way that a diagnosis goes."""
    fitting, base = fitted(*acting)
    errors = ModelErrors(10.0, 10.0, 0.0025)
    model = cast(Any, SimpleNamespace(fitting=fitting, width=0.3, errors=lambda fit: errors))
    kinds = (*KINDS, JointFit, RefinedMotion)
    store = StageStore(folder, ValueStore(kinds, CANDIDATES), StageTimes())
    pipeline = Pipeline(store, lambda what, share: None)
    stages = HypothesisStages(model, lambda what, share: None, {})
    nothing = RefinedMotion([], None)
    motion = pipeline.run(
        PipelineStage("motion", "motion.npz", "motion", 0.0, RefinedMotion, lambda: nothing)
    )
    plain = pipeline.run(
        PipelineStage("plain", "plain.npz", "plain", 0.0, JointFit, lambda: base),
    )
    evidence = fitting.quadratic(CANDIDATES, plain, fitting.systems(CANDIDATES, plain))
    found = fitting.linearised(CANDIDATES, plain, evidence)
    drops = {name: plain.misfit - fit.misfit for name, fit in found.items()}
    probable = dict.fromkeys((NONE, *drops), 0.0) | {max(drops, key=lambda name: drops[name]): 0.6}
    beside = EffectsBeside(
        pipeline, stages, motion, plain, {}, CANDIDATES, OutsideCauses({}), None, SessionWeights(), foretold
    )
    return beside.second(probable, SETTINGS, 0.5)


def test_two_effects_are_found_together(tmp_path: Path) -> None:
    found = second(tmp_path, drag(2.0), UNEVEN)
    assert {found.first, found.name} == {"air_drag", "anisotropic_stiffness"}
    assert found.chances[found.name] == next(iter(found.chances.values())) > 0.9
    assert sum(found.chances.values()) == pytest.approx(1.0)
    assert found.first not in found.chances
    mean, covariance = found.found["air_drag"]
    # A part of it is taken for quadratic.
    assert 0.5 * 2.0 < mean[0] * drag(0.0).scales[0] < 1.1 * 2.0
    assert covariance.shape == (len(mean), len(mean))


@pytest.mark.parametrize(("high", "believed"), [(-0.01, False), (0.01, True)])
def test_a_second_effect_that_predicts_worse_is_not_believed(
    tmp_path: Path, high: float, believed: bool
) -> None:
    asked: list[tuple[tuple[str, ...], tuple[str, ...], str]] = []
    shrink = Shrink("position [mm]", "the last clip", 1.0, 1.1, -0.1, -0.2, high)

    def foretold(fitting: JointFitting, with_first: JointFit, fit: JointFit, effect: Effect) -> Shrink:
        assert tuple(e.NAME for e in fitting.usual) == with_first.names
        asked.append((with_first.names, fit.names, effect.NAME))
        return shrink

    found = second(tmp_path, drag(2.0), UNEVEN, foretold=foretold)
    first, other = found.first, next(iter(found.chances))
    assert asked == [((first,), (first, other), other)]
    assert (found.name, found.shrink) == (other if believed else "", shrink)
    assert bool(found.found) == bool(len(found.values)) == believed
    assert found.unless([other]).shrink == shrink


@pytest.mark.parametrize("acting", [drag(1.2), UNEVEN])
def test_one_effect_is_not_taken_for_two(tmp_path: Path, acting: Effect) -> None:
    found = second(tmp_path, acting)
    assert (found.first, found.name) == (acting.NAME, "")
    assert next(iter(found.chances)) == NONE


@pytest.mark.parametrize(
    ("probable", "asked", "first"),
    [
        ({"air_drag": 0.5, "gusts": 0.4, NONE: 0.1}, ["air_drag", "gusts"], "gusts"),
        ({"air_drag": 0.9, "gusts": 0.1, NONE: 0.0}, ["air_drag"], "air_drag"),
        ({"air_drag": 0.0, "gusts": 0.9, NONE: 0.1}, ["gusts"], "gusts"),
    ],
)
def test_it_is_asked_beside_each_of_two_that_are_level(
    probable: dict[str, float], asked: list[str], first: str
) -> None:
    """Only beside gusts is there anything; that is asked where they are the first, or level with it."""
    were: list[str] = []

    class Beside(EffectsBeside):
        def _beside_first(self, first: str, settings: VerdictSettings, share: float) -> SecondEffect:
            were.append(first)
            return SecondEffect(first, {}, "internal_damping" if first == "gusts" else "", {})

    two = [CATALOGUE[name]() for name in ("air_drag", "gusts")]
    beside = Beside(*[None] * 5, two, OutsideCauses({}), None, SessionWeights())  # type: ignore[arg-type]
    assert beside.second(probable, SETTINGS, 0.5).first == first
    assert were == asked


def test_what_two_effects_gain_does_not_hang_on_their_order() -> None:
    """The quadratic has one minimum for both: first gain and second gain add up to the same."""
    fitting, base = fitted(drag(1.2))
    evidence = fitting.quadratic(CANDIDATES, base, fitting.systems(CANDIDATES, base))
    alone = fitting.linearised(CANDIDATES, base, evidence)
    one, other = CANDIDATES[1:]

    def gains(first: Effect, then: Effect) -> float:
        given = fitting.with_usual((first,))
        with_first = given.with_effect_at_zero(base, first)
        beside = given.linearised(CANDIDATES, with_first, evidence)[then.NAME]
        return 2 * base.misfit - alone[first.NAME].misfit - beside.misfit

    assert gains(one, other) == pytest.approx(gains(other, one), rel=1e-6)
    assert gains(one, other) > 1.0


def test_causes_from_outside_are_known_beside_each_other() -> None:
    """A drag is as sure beside a density that is there too; where it alone acts, nothing is beside it."""
    heavy = CATALOGUE["nonuniform_density"]({"mode_01": 0.6})
    strong, found = drag(3 * DRAG), test_joint_fit.TestCausesFromOutside().found
    both, alone = (found(*acting)[0].causes for acting in ((strong, heavy), (strong,)))
    assert both["air_drag"].beside["nonuniform_density"].nats() > 4
    assert both["nonuniform_density"].beside["air_drag"].nats() > 4
    assert alone["air_drag"].beside["nonuniform_density"].nats() < 2
    assert "air_drag" not in alone["air_drag"].beside


def test_two_rivals_that_both_act_are_the_answer() -> None:
    open_ = Verdict(AMBIGUOUS, ("air_drag", "gusts"), "unknown", 0.97, "…", "another clip")
    found = of_two(open_, "air_drag", "gusts", 0.93)
    assert (found.effect, found.also, found.probability) == ("air_drag", "gusts", 0.93)
    assert found.candidates == ("air_drag", "gusts")
    assert not found.next_recording
    named = Verdict("air_drag", ("air_drag",), "mechanics", 0.95, "…", "")
    assert of_two(named, "air_drag", "gusts", 0.9).also == "gusts"
    assert of_two(named, "air_drag", "gusts", 0.9).probability == 0.95
    # Beside an effect of the image there is no other place for it.
    lit = of_two(replace(named, also="shading"), "air_drag", "gusts", 0.9)
    assert (lit.also, lit.candidates) == ("shading", ("air_drag", "gusts"))
    none = Verdict(NONE, (NONE,), NONE, 0.95, "…", "")
    assert of_two(none, "air_drag", "gusts", 0.9) == none


def test_a_second_effect_that_predicts_worse_than_nothing_is_not_believed() -> None:
    chances = {"air_drag": 0.97, "none": 0.03}
    second = SecondEffect("gusts", chances, "air_drag", {"air_drag": (np.ones(1), np.eye(1))})
    assert second.unless(("contact",)) is second
    left = second.unless(("air_drag",))
    assert (left.first, left.chances, left.name, left.found) == ("gusts", chances, "", {})
