"""Probabilities, confidence sets and verdicts."""

from __future__ import annotations

import pytest

from toile.diagnosis.decision import (
    NONE,
    UNKNOWN,
    Calibration,
    Weights,
    confidence_set,
    probabilities,
    tempered,
)
from toile.diagnosis.findings import Finding, estimates
from toile.diagnosis.record import AMBIGUOUS
from toile.diagnosis.recordings import next_recording
from toile.diagnosis.verdict import VerdictSettings, until, verdict_of
from toile.effects.catalogue import CATALOGUE

CALIBRATION = Calibration({"frame_rate": 10.0}, {"frame_rate": 5.0}, 1.0, 4.0, 6.0, "test")


def test_the_shipped_calibration_knows_catalogue_names_only() -> None:
    shipped = Calibration.load()
    assert {*shipped.usual, *shipped.spread} <= {*CATALOGUE, UNKNOWN}
    assert shipped.temperature > 0


def test_nothing_found_is_none() -> None:
    found = probabilities({"air_drag": -3.0, UNKNOWN: 0.0}, CALIBRATION)
    assert next(iter(found)) == NONE
    assert confidence_set(found) == (NONE,)
    assert sum(found.values()) == pytest.approx(1)


def test_what_is_usual_counts_for_nothing() -> None:
    found = probabilities({"frame_rate": 12.0, "air_drag": 12.0}, CALIBRATION)
    assert next(iter(found)) == "air_drag"
    assert found["frame_rate"] < 0.01


def verdict(evidence: dict[str, float]):
    found = probabilities(evidence, CALIBRATION)
    known = {name: value for name, value in evidence.items() if name != UNKNOWN}
    return verdict_of(found, known, CALIBRATION, {})


def test_two_equals_are_ambiguous_and_name_the_recording_that_parts_them() -> None:
    answer = verdict({"air_drag": 20.0, "internal_damping": 20.5})
    assert answer.effect == AMBIGUOUS
    assert set(answer.candidates) == {"air_drag", "internal_damping"}
    assert answer.stage == "mechanics"
    assert "shaken" in answer.next_recording


def test_forces_that_nothing_supplies_are_unknown() -> None:
    answer = verdict({"air_drag": 3.0, UNKNOWN: 40.0})
    assert answer.effect == UNKNOWN
    assert answer.next_recording
    assert answer.also is None
    assert verdict({UNKNOWN: 40.0, "shading": 30.0}).also == "shading"


def test_a_second_stage_with_a_trace_of_its_own_is_named_too() -> None:
    answer = verdict({"air_drag": 40.0, "mask_bias": 25.0})
    assert (answer.effect, answer.also) == ("air_drag", "mask_bias")
    assert verdict({"air_drag": 40.0, "mask_bias": 5.0}).also is None


def test_what_is_far_ahead_is_the_answer_though_the_set_holds_more() -> None:
    found = {NONE: 0.7, "gusts": 0.15, "air_drag": 0.1, "shading": 0.05}
    answer = verdict_of(found, {}, CALIBRATION, {})
    assert answer.effect == NONE
    assert answer.candidates == (NONE, "gusts", "air_drag")
    assert answer.probability == 0.7
    for close in ({NONE: 0.55, "gusts": 0.45}, {NONE: 0.4, "gusts": 0.1, "air_drag": 0.1}):
        assert verdict_of(close, {}, CALIBRATION, {}).effect == AMBIGUOUS


def test_a_clip_that_says_nothing_speaks_for_nothing() -> None:
    """Though on other clips the evidence is against the effect."""
    calibration = Calibration({"motion_blur": -8.0}, {}, 1.0, 4.0, 6.0, "test")
    assert calibration.score("motion_blur", 0.0) == 0.0
    assert next(iter(probabilities({"motion_blur": 0.0}, calibration))) == NONE


def test_what_hardly_moves_the_cloth_counts_for_little() -> None:
    weights = Weights(in_sample=0.5, predictive=10.0, smallest=0.01)
    whole = weights.combined(40.0, 0.1)
    assert whole == pytest.approx(21.0)
    assert weights.combined(40.0, 0.1, 0.02) == whole
    assert weights.combined(40.0, 0.1, 0.002) == pytest.approx(0.04 * whole)
    # What speaks against it is not weakened.
    assert weights.combined(-8.0, 0.0, 0.002) == -4.0


def test_no_more_recordings_are_asked_for_than_somebody_would_make() -> None:
    many = ("none", "air_drag", "gravity_tilt", "frame_rate", "anisotropic_stiffness", "rest_curvature")
    asked = next_recording(many).split("; ")
    assert len(asked) == 3
    assert "shaken" in asked[0]
    # Those of the most probable ones.
    assert asked[1:] == next_recording(("air_drag", "gravity_tilt")).split("; ")[1:]


def test_what_the_time_step_is_wrong_by_comes_first() -> None:
    weights = Weights(in_sample=0.5, predictive=10.0, smallest=0.01)
    whole = weights.combined(40.0, 0.1, 0.02)
    assert weights.combined(40.0, 0.1, 0.02, 0.01) == whole
    assert weights.combined(40.0, 0.1, 0.02, 0.05) == pytest.approx(0.04 * whole)
    assert weights.combined(40.0, 0.1, 0.005, 0.02) == pytest.approx(0.25 * 0.25 * whole)
    assert weights.combined(-8.0, 0.0, 0.02, 0.05) == -4.0


def test_a_lost_track_is_said() -> None:
    answer = verdict_of({NONE: 0.97, "air_drag": 0.03}, {"air_drag": 0.0}, CALIBRATION, {})
    lost = until(answer, 22)
    assert lost.effect == NONE
    assert lost.reason.startswith(answer.reason)
    assert "loses the cloth in frame 22" in lost.reason


@pytest.mark.parametrize(("clips", "subject"), [(1, "This clip"), (3, "These clips")])
def test_the_reason_speaks_of_as_many_clips_as_there_are(clips: int, subject: str) -> None:
    found = {"air_drag": 0.5, "gusts": 0.4, "none": 0.1}
    said = verdict_of(found, {}, CALIBRATION, {}, clips=clips)
    assert said.reason == f"{subject} cannot tell air_drag, gusts apart."


def test_none_does_not_say_that_all_is_explained_where_it_is_not() -> None:
    found = {NONE: 0.97, "air_drag": 0.03}
    sure = verdict_of(found, {"air_drag": 0.0}, CALIBRATION, {})
    unsure = verdict_of(found, {"air_drag": 0.0}, CALIBRATION, {}, explained=False)
    assert sure.effect == unsure.effect == NONE
    assert "explains the clip to within its noise" in sure.reason
    assert "no proof" in unsure.reason


def test_a_clip_that_nothing_explains_says_less_of_effects() -> None:
    assert tempered(30.0, 10.0, 15.0) == 30.0
    assert tempered(30.0, 15.0, 15.0) == 30.0
    assert tempered(30.0, 90.0, 15.0) == pytest.approx(5.0)
    # A cost below zero is as good as any, and what speaks against an effect stays.
    assert tempered(30.0, -20.0, 15.0) == 30.0
    assert tempered(-8.0, 90.0, 15.0) == -8.0


def test_an_answer_is_given_when_the_settings_say() -> None:
    found = {"air_drag": 0.62, "gusts": 0.3, NONE: 0.08}

    def answer(**settings: float):
        return verdict_of(found, {}, CALIBRATION, {}, settings=VerdictSettings(**settings))

    assert answer().effect == AMBIGUOUS
    assert answer(ahead=2.0).effect == "air_drag"
    assert answer(ahead=2.0, likely=0.7).effect == AMBIGUOUS
    assert answer(ahead=2.0, named=0.7).effect == AMBIGUOUS
    # That nothing acts needs no more than before.
    nothing = {NONE: 0.62, "gusts": 0.1}
    assert verdict_of(nothing, {}, CALIBRATION, {}, settings=VerdictSettings(named=0.9)).effect == NONE
    assert answer().candidates == ("air_drag", "gusts")
    assert answer(level=0.95).candidates == ("air_drag", "gusts", NONE)
    both = {"air_drag": 40.0, "mask_bias": 25.0}
    chances = probabilities(both, CALIBRATION)
    # 25 deviations are more than two times the threshold of 4, and less than seven times.
    assert verdict_of(chances, both, CALIBRATION, {}).also == "mask_bias"
    assert verdict_of(chances, both, CALIBRATION, {}, settings=VerdictSettings(beside=7.0)).also is None


def test_intervals_are_as_wide_as_the_settings_say() -> None:
    effect = CATALOGUE["gravity_tilt"]()
    name = effect.parameters[0].name
    numbers = {p.name: 0.0 for p in effect.parameters}
    found = Finding(0.0, numbers, {p.name: 1e-3 for p in effect.parameters})
    narrow, wide = (estimates(found, effect, widened)[name] for widened in (1.0, 3.0))
    assert wide.high - wide.low == pytest.approx(3 * (narrow.high - narrow.low))
    assert narrow.high == pytest.approx(1.645e-3)
