"""Marks of answers that are known to be right or wrong."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from toile.blind.measures import Statistic, confusion, detection, mark, measured
from toile.blind.sealing import Sealed
from toile.diagnosis.record import (
    Alias,
    EffectReport,
    Estimate,
    GapReport,
    Protocol,
    Shrink,
    Verdict,
    Where,
)

EMPTY = np.zeros((1, 1, 1, 3), np.float32)


def label(*effects: str, stage: str = "mechanics", inside: bool = True, gap: float = 3.0) -> dict[str, Any]:
    return {
        "effect": "+".join(effects) or "none",
        "effects": list(effects),
        "levels": ["medium"] * len(effects),
        "stage": stage if effects else "none",
        "stage_accept": [stage] if effects else ["none"],
        "in_catalogue": inside,
        "generator": "toile",
        "comparable": {},
        "magnitude": {
            "mean_last_third": gap if effects else 0.0,
            "alone": {e: {"value": gap, "measure": "motion"} for e in effects},
        },
        "localisation": {"vertices": [0], "frames": [2, 3]},
    }


def answer(effect: str, *candidates: str, stage: str = "mechanics", p: float = 0.95, also: str | None = None):
    shrink = Shrink("position", "late", 10.0, 4.0, 0.6, 0.5, 0.7, 0.12)
    return GapReport(
        Verdict(effect, candidates or (effect,), stage, p, "", "", also),
        Where({}, (1.0, 1.0, 4.0, 3.0), None),
        (
            EffectReport("air_drag", "mechanics", 0.9, {}, shrink),
            EffectReport("frame_rate", "mechanics", 0.0, {"log_factor": Estimate(0.11, 0.09, 0.13, "1")}),
            EffectReport(
                "gusts",
                "actuation",
                0.1,
                {},
                replace(shrink, with_effect=9.0, estimate=0.1, low=0.0, high=0.2, best_placebo=0.06),
            ),
        ),
        Alias(("air_drag", "gusts"), ((1.0, 0.3), (0.3, 1.0)), {"air_drag": 0.2}),
        Protocol(0, (0,), (1,), "", "gusts"),
    )


def marked(truth: dict[str, Any], report: GapReport | None, alias: float = 0.9) -> dict[str, Any]:
    return mark("x", Sealed(truth, EMPTY, EMPTY), report, Path(), alias=alias)


def test_right_single() -> None:
    row = marked(label("air_drag"), answer("air_drag"))
    assert row["kind"] == "single"
    assert row["top1"]
    assert row["stage_right"]
    assert row["set_right"]
    assert row["identifiable"]
    assert row["placebo_of_true"] == pytest.approx(0.2)
    assert row["improved"]
    assert row["frames_f1"] == 1.0
    assert not row["naive_top1"]
    assert row["naive_confidently_wrong"]


def test_magnitude_of_a_number_that_both_sides_have() -> None:
    row = marked(slow_camera(), answer("frame_rate"))
    assert row["magnitude_error"] == pytest.approx(0.1)
    assert row["magnitude_covered"]
    assert "magnitude_error" not in marked(label("air_drag"), answer("air_drag"))


def slow_camera() -> dict[str, Any]:
    """A clip from Blender whose frames are further apart than declared, by a logarithm of 0.1."""
    return {**label("frame_rate"), "generator": "blender", "parameters": {"error": np.expm1(-0.1)}}


def test_aliased_single_should_be_called_ambiguous() -> None:
    row = marked(label("air_drag"), answer("ambiguous", "air_drag", "gusts"), alias=0.25)
    assert row["identifiable"] is False
    assert row["called_ambiguous"]
    assert not row["top1"]


def test_nulls_outside_and_pairs() -> None:
    assert marked(label(), answer("air_drag"))["false_alarm"]
    assert not marked(label(), answer("none", stage="none"))["false_alarm"]
    assert not marked(label(), answer("ambiguous", "air_drag", "none"))["false_alarm"]
    outside = label("vortex_field", inside=False)
    assert marked(outside, answer("unknown"))["abstains"]
    assert marked(outside, answer("air_drag"))["confidently_wrong"]
    assert not marked(outside, answer("air_drag", p=0.5))["confidently_wrong"]
    pair = label("air_drag", "shading")
    assert marked(pair, answer("air_drag"))["pair_right"]
    assert marked(pair, answer("shading", also="air_drag"))["pair_right"]
    assert not marked(pair, answer("air_drag", also="gusts"))["pair_right"]
    assert not marked(pair, answer("none"))["pair_right"]


def test_no_diagnosis_is_wrong() -> None:
    row = marked(label("air_drag"), None)
    assert not row["top1"]
    assert not row["stage_right"]


def test_table() -> None:
    rows = [marked(label("air_drag"), answer("air_drag")) for _ in range(9)]
    rows += [marked(label("air_drag"), answer("gusts", stage="actuation"))]
    rows += [marked(label(), answer("none", stage="none")) for _ in range(5)]
    marks = pd.DataFrame(rows)
    table = measured(marks, resamplings=200, seed=0).set_index("measure")
    assert table.loc["stage accuracy", "value"] == pytest.approx(14 / 15)
    top = table.loc["top-1 effect, identifiable singles"]
    assert top["value"] == pytest.approx(0.9)
    assert top["low"] < 0.9 < top["high"]
    assert top["naive"] == 0.0
    assert table.loc["false alarms on nulls", "high"] > 0.3  # five nulls say little
    assert table.loc["false alarms on nulls", "scenes"] == 5
    assert table.loc["scenes improved", "scenes"] == 10
    assert table.loc["false alarms on nulls", "naive"] == 1.0
    assert np.isnan(table.loc["outside: abstains", "value"])
    assert confusion(marks).loc["air_drag", "gusts"] == 1
    found = detection(marks).set_index("effect").loc["air_drag"]
    assert (found["found"], found["scenes"]) == (9, 10)


def test_interval_over_scenes() -> None:
    """As wide as the deviation of the mean says, the same every time, and none of a single scene."""
    values = np.random.default_rng(2).standard_normal(200)
    rows = pd.DataFrame({"truth": ["air_drag"] * 200, "error": values})
    low, high = Statistic("error").interval(rows, 2000, np.random.default_rng(0))
    assert low < values.mean() < high
    assert high - low == pytest.approx(2 * 1.96 * values.std() / 200**0.5, rel=0.1)
    assert (low, high) == Statistic("error").interval(rows, 2000, np.random.default_rng(0))
    assert Statistic("error").interval(rows[:1], 20, np.random.default_rng(0)) == (values[0], values[0])


def test_worst_effect() -> None:
    rows = pd.DataFrame(
        {"truth": ["gusts", "gusts", "air_drag", "shading"], "top1": [True, False, True, None]}
    )
    worst = Statistic("top1", worst_effect=True)
    assert worst(rows) == 0.5
    assert worst.interval(rows, 200, np.random.default_rng(0)) == (0.0, 1.0)


def test_wilson_where_all_scenes_agree() -> None:
    marks = pd.DataFrame([marked(label(), answer("none", stage="none")) for _ in range(10)])
    table = measured(marks.assign(identifiable=None, naive_top1=None), resamplings=20, seed=0)
    row = table.set_index("measure").loc["false alarms on nulls"]
    assert row["low"] == 0.0
    assert row["high"] == pytest.approx(1.96**2 / (10 + 1.96**2), rel=1e-4)


def test_the_worst_effect_is_as_sure_as_its_own_scenes() -> None:
    right = [marked(label("frame_rate"), answer("frame_rate")) for _ in range(8)]
    wrong = [marked(label(name), answer("frame_rate")) for name in ("air_drag", "gusts") for _ in range(2)]
    wrong += [marked(label("internal_damping"), answer("frame_rate")) for _ in range(3)]
    marks = pd.DataFrame(right + wrong).assign(identifiable=True, naive_top1=None)
    row = measured(marks, resamplings=20, seed=0).set_index("measure").loc["top-1, worst effect"]
    assert row["value"] == 0.0
    assert row["high"] == pytest.approx(1.96**2 / (2 + 1.96**2), rel=1e-4)


def test_vertices_that_move_are_not_where_a_cause_is(tmp_path: Path) -> None:
    """Labels of Blender's scenes before format 2: any map of a drag had 0.8."""
    report = replace(answer("air_drag"), where=Where({}, (1.0, 1.0, 4.0, 3.0), "scores.npy"))
    np.save(tmp_path / "scores.npy", np.linspace(0, 1, 4)[:, None] * np.ones(3))
    vertices = np.zeros((4, 4, 3, 3), np.float32)
    for engine, known in (({}, True), ({"engine": "blender", "format": 1}, False)):
        truth = {**label("air_drag"), **engine}
        row = mark("x", Sealed(truth, vertices, vertices), report, tmp_path, alias=0.9)
        assert ("vertices_auprc" in row) == known
    truth = {**label("air_drag"), "engine": "blender", "format": 2}
    assert "vertices_auprc" in mark("x", Sealed(truth, vertices, vertices), report, tmp_path, alias=0.9)


def test_scores_on_another_grid_than_the_labels(tmp_path: Path) -> None:
    """Vertices of a label count on the scene's grid, scores on that of the model."""
    report = answer("air_drag")
    report = replace(report, where=replace(report.where, vertices="scores.npy"))
    np.save(tmp_path / "scores.npy", np.linspace(0, 1, 4)[:, None] * np.ones(3))
    truth = label("air_drag")
    vertices = np.zeros((4, 7, 9, 3), np.float32)
    # The last row of 7 × 9 has the highest scores; all scores of the first row are the lowest.
    for acting, score in ((range(54, 63), 1.0), (range(9), 1 / 7)):
        truth["localisation"]["vertices"] = list(acting)
        row = mark("x", Sealed(truth, vertices, vertices), report, tmp_path, alias=0.9)
        assert row["vertices_auprc"] == pytest.approx(score)
    # Where the effect that is named acts is asked first.
    named = replace(report, where=replace(report.where, acts_on="acts.npy"))
    np.save(tmp_path / "acts.npy", np.linspace(1, 0, 7)[:, None] * np.ones(9))
    row = mark("x", Sealed(truth, vertices, vertices), named, tmp_path, alias=0.9)
    assert row["vertices_auprc"] == pytest.approx(1.0)
    truth["localisation"]["vertices"] = list(range(63))
    row = mark("x", Sealed(truth, vertices, vertices), report, tmp_path, alias=0.9)
    assert "vertices_auprc" not in row


def test_only_scenes_with_a_mark_count() -> None:
    # Of gusts no magnitude is known that could be compared.
    other = label("gusts", stage="actuation", gap=2.0)
    rows = [marked(slow_camera(), answer("frame_rate")), marked(other, answer("gusts", stage="actuation"))]
    table = measured(pd.DataFrame(rows), resamplings=20, seed=0).set_index("measure")
    assert table.loc["magnitude: median error", "scenes"] == 1
    assert table.loc["top-1 effect, identifiable singles", "scenes"] == 2


def test_size_is_missing_where_nothing_names_it() -> None:
    optical = label("motion_blur", stage="appearance")
    optical["magnitude"] = {"mean_last_third": 0.0, "alone": {}}
    assert np.isnan(marked(optical, answer("motion_blur", stage="appearance"))["size"])


def test_runner_up_and_placebo_without_the_true_effect() -> None:
    row = marked(label("frame_rate"), answer("air_drag"))
    assert "shrink_true" not in row
    assert (row["runner_up"], row["shrink_runner_up"], row["shrink_placebo"]) == ("air_drag", 0.6, 0.12)
    assert "improved" not in row
