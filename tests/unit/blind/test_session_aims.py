"""The aims of sessions, held against a table of measures."""

from __future__ import annotations

import pandas as pd
import pytest

from toile.blind.session_aims import NAMED, SESSION_AIMS, SessionAim, against_aims
from toile.blind.session_measures import measured_sessions, session_measures


def test_every_aim_is_one_of_a_measure() -> None:
    marks = pd.DataFrame({"clips": ["3"], "generator": ["toile"], "kind": ["null"], "of_the_image": [False]})
    names = {measure.name for measure in session_measures(marks)} | {"calibration error"}
    assert {aim.measure for aim in SESSION_AIMS} <= names
    places = [(aim.measure, aim.generator, aim.clips) for aim in SESSION_AIMS]
    assert len(set(places)) == len(places)


@pytest.mark.parametrize(
    ("aim", "text", "value", "interval", "reached", "sure"),
    [
        (SessionAim(NAMED, "3", 0.75), "≥ 0.75", 0.8, (0.5, 0.9), True, False),
        (SessionAim(NAMED, "3", 0.75), "≥ 0.75", 0.8, (0.76, 0.9), True, True),
        (SessionAim(NAMED, "3", 0.75), "≥ 0.75", 0.5, (0.2, 0.8), False, False),
        (SessionAim(NAMED, "3", 0.75), "≥ 0.75", 0.5, (0.2, 0.7), False, True),
        (SessionAim("size", "3", at_most=3.0), "≤ 3", 2.0, (1.5, 2.5), True, True),
        (SessionAim("size", "3", at_most=3.0), "≤ 3", 4.0, (2.5, 5.0), False, False),
        (SessionAim("size", "3", at_most=3.0), "≤ 3", 4.0, (3.5, 5.0), False, True),
        (SessionAim("held", "3", 0.85, 0.95), "0.85–0.95", 0.9, (0.8, 1.0), True, False),
        (SessionAim("held", "3", 0.85, 0.95), "0.85–0.95", 0.98, (0.96, 1.0), False, True),
        (SessionAim("held", "3", 0.85, 0.95), "0.85–0.95", 0.6, (0.4, 0.8), False, True),
    ],
)
def test_an_aim_is_reached_by_the_value_and_surely_by_the_interval(
    aim: SessionAim, text: str, value: float, interval: tuple[float, float], reached: bool, sure: bool
) -> None:
    assert aim.text == text
    assert aim.holds(value) == reached
    assert aim.sure(value, *interval) == sure


def test_what_nothing_was_measured_of_is_said_so() -> None:
    marks = pd.DataFrame(
        {
            "clips": ["3"] * 7,
            "generator": ["toile"] * 7,
            "kind": ["null"] * 6 + ["single"],
            "of_the_image": [False] * 7,
            "false_alarm": [False, False, False, False, True, True, True],
            "asked_percent": [float("nan")] * 6 + [3.0],
            "gap_percent": [0.0] * 6 + [3.1],
            "right": [False] * 6 + [True],
            "set_size": [float("nan")] * 6 + [1.0],
        }
    )
    table = against_aims(measured_sessions(marks, resamplings=20, seed=0))
    table = table.set_index(["measure", "generator", "clips"])
    alarms = table.loc[("false alarms on nulls", "all", "3")]
    assert (alarms["reached"], alarms["sure"]) == ("no", "yes")  # two of six, beyond any doubt above 0.02
    assert alarms["measured"].startswith("0.33 [")
    named = table.loc[(NAMED, "toile", "3")]
    assert (named["reached"], named["sure"]) == ("yes", "no")  # one of one
    size = table.loc[("90 % set: mean size", "all", "3")]
    assert (size["reached"], size["sure"]) == ("yes", "no")  # resampled from one session
    assert table.loc[(NAMED, "blender", "3")]["measured"] == "–"
