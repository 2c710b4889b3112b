"""Clips of which tracking has lost the cloth: it is said, and no `none` rests on a few frames."""

from __future__ import annotations

import pytest

from toile.diagnosis.record import AMBIGUOUS, Verdict
from toile.diagnosis.verdict import seen_in_part

NOTHING = Verdict("none", ("none",), "none", 0.9, "The base model explains the clip.", "")
CHANCES = {"none": 0.58, "gusts": 0.19, "air_drag": 0.14, "unknown": 0.09}
DRAG = Verdict("air_drag", ("air_drag",), "mechanics", 0.95, "air_drag explains what is missed.", "")


def test_clips_that_are_seen_whole_change_nothing() -> None:
    assert seen_in_part(NOTHING, CHANCES, [("first", 40, 40), ("second", 80, 80)]) == NOTHING


def test_a_few_frames_do_not_say_that_nothing_acts() -> None:
    found = seen_in_part(NOTHING, CHANCES, [("first", 6, 40)])
    assert found.effect == AMBIGUOUS
    assert found.candidates == ("none",)
    assert "frame 6 of first" in found.reason
    assert "6 frames before, of 40" in found.reason
    assert found.next_recording


@pytest.mark.parametrize("verdict", [NOTHING, DRAG])
def test_what_most_frames_say_stays_and_the_loss_is_said(verdict: Verdict) -> None:
    found = seen_in_part(verdict, CHANCES, [("first", 40, 40), ("second", 30, 40)])
    assert found.effect == verdict.effect
    assert "frame 30 of second" in found.reason
    assert "first" not in found.reason


def test_an_effect_that_shows_in_a_few_frames_is_still_one() -> None:
    assert seen_in_part(DRAG, CHANCES, [("first", 6, 40)]).effect == "air_drag"


def test_clips_of_one_name_count_each() -> None:
    found = seen_in_part(NOTHING, CHANCES, [("clip", 6, 40), ("clip", 10, 40)])
    assert "16 frames before, of 80" in found.reason


def test_what_becomes_ambiguous_has_the_probability_of_all_candidates() -> None:
    unsure = Verdict("none", ("none", "gusts", "air_drag"), "none", 0.58, "Nothing shows.", "")
    found = seen_in_part(unsure, CHANCES, [("first", 22, 80)])
    assert found.probability == pytest.approx(0.91)
