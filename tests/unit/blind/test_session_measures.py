"""Marks of sessions: classes, sets, probabilities, sizes."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from toile.blind.answers import LOSS_DROP, read_answer
from toile.blind.sealing import Sealed
from toile.blind.session_measures import (
    by_size,
    calibration_error,
    mark_session,
    measured_sessions,
    reliability,
    wilson,
)
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
from toile.errors import InputError

FRAMES = (4, 4)
NONE: Mapping[str, Shrink] = {}


def shrunk(to: float, placebo: float = 9.0) -> Shrink:
    """From 10 mm to so many; the best placebo's 9 mm by default."""
    share = 1 - to / 10
    return Shrink("position [mm]", "clip 3", 10.0, to, share, share - 0.05, share + 0.05, 1 - placebo / 10)


def answered(
    folder: Path, effect: str, probability: float = 0.8, shrinks: Mapping[str, Shrink] = NONE, **added: Any
) -> Path:
    """diagnosis.json with what a session adds."""
    strength = {"c": Estimate(2.0, 1.0, 3.0, "1/s")}
    drag = EffectReport("air_drag", "mechanics", 0.1, strength, shrinks.get("air_drag"))
    gusts = EffectReport("gusts", "actuation", 0.1, {}, shrinks.get("gusts"))
    report = GapReport(
        Verdict(effect, (effect, "air_drag"), "mechanics", probability, "", ""),
        Where({"mechanics": 1.0}, (3.0, 0.0, 3.0, 0.0, 3.0, 3.0, 0.0, 0.0), None),
        (drag, gusts) if shrinks else (drag,),
        Alias(("air_drag",), ((1.0,),), {"air_drag": 0.5}),
        Protocol(0, (0,), (), "test", "gusts"),
    )
    path = folder / "diagnosis.json"
    values = report.to_json()
    if "next_recording" in added:
        values["verdict"]["next_recording"] = added.pop("next_recording")
    path.write_text(json.dumps({**values, **added}))
    return path


def sealed(*effects: str, percent: float = 3.0, outside: bool = False) -> Sealed:
    label = {
        "effect": "+".join(effects) or "none",
        "effects": list(effects),
        "levels": [f"{percent:g} %"] * len(effects),
        "stage": "mechanics",
        "stage_accept": ["mechanics"],
        "in_catalogue": not outside,
        "magnitude": {
            "mean_last_third": percent if effects else 0.0,
            "alone": {e: {"value": percent} for e in effects},
        },
        "localisation": {"vertices": None, "frames": [0, 2]},
        "generator": "toile",
        "n_frames": list(FRAMES),
        "clips": [
            {"localisation": {"vertices": None, "frames": [0, 2]}},
            {"localisation": {"vertices": None, "frames": [0, 1]}},
        ],
    }
    motion = np.zeros((sum(FRAMES), 3, 3, 3), np.float32)
    return Sealed(label, motion, motion)


def marks(folder: Path, truth: Sealed, effect: str, **added: Any) -> dict[str, Any]:
    path = answered(folder, effect, **added)
    return mark_session("s", truth, read_answer(path), folder, 60.0)


def test_the_effect_itself_is_right(tmp_path: Path) -> None:
    found = marks(tmp_path, sealed("air_drag"), "air_drag")
    assert found["right"]
    assert found["set_right"]
    assert found["relative_size"] == pytest.approx(4.0)
    assert found["frames_f1"] == 1.0  # of both clips in a row
    assert found[f"right [{LOSS_DROP}]"] is False


def test_when_the_cloth_is_moved_is_graded_alike_for_all_generators(tmp_path: Path) -> None:
    truth = sealed("air_drag")
    truth.label["magnitude"]["per_frame_mean"] = [0.0, 0.4, 0.9, 3.0]  # % of the width
    session = {"clips": ["a"], "frames": [4], "equivalence_classes": [], "material": {}, "left": 1.0}
    session |= {"probabilities": {"air_drag": 1.0}, "moved_by": "air_drag"}
    scores = {}
    for name, moved in {
        "right": (0.0, 0.001, 0.006, 0.02),
        "late": (0.0, 0.0, 0.0, 0.02),
        "nowhere": (0.0,) * 4,
    }.items():
        found = marks(tmp_path, truth, "air_drag", session={**session, "moved": moved})
        scores[name] = found["frames_f1"]
        assert found["frames_f1 [every frame]"] == pytest.approx(2 / 3)
    assert scores == {"right": 1.0, "late": pytest.approx(2 / 3), "nowhere": 0.0}
    # Moved from the first frame to the last, it says nothing: any answer would do.
    truth.label["magnitude"]["per_frame_mean"] = [1.0] * 4
    everywhere = marks(tmp_path, truth, "air_drag", session={**session, "moved": (0.02,) * 4})
    assert everywhere["frames_f1"] == marks(tmp_path, truth, "air_drag")["frames_f1"]


def test_a_declared_class_is_one_answer(tmp_path: Path) -> None:
    classes = {"equivalence_classes": [["gravity_tilt", "wind"]], "class": ["gravity_tilt", "wind"]}
    truth = sealed("gravity_tilt")
    assert not marks(tmp_path, truth, "wind")["right"]
    assert marks(tmp_path, truth, "wind", **classes)["right"]
    ambiguous = marks(tmp_path, truth, "ambiguous", set=["wind", "gravity_tilt", "air_drag"], **classes)
    assert ambiguous["right"]
    assert ambiguous["set_right"]
    assert ambiguous["set_size"] == 2.0
    assert not ambiguous["abstains"]


def test_a_class_that_was_not_declared_is_none(tmp_path: Path) -> None:
    everything = {"class": ["air_drag", "gusts", "gravity_tilt"]}
    assert not marks(tmp_path, sealed("gusts"), "air_drag", **everything)["right"]
    assert not marks(tmp_path, sealed("gusts"), "ambiguous", **everything)["right"]


def test_nulls(tmp_path: Path) -> None:
    assert marks(tmp_path, sealed(), "none")["false_alarm"] is False
    assert marks(tmp_path, sealed(), "unknown")["false_alarm"] is True
    assert marks(tmp_path, sealed(), "air_drag")["false_alarm"] is True
    classes = {"equivalence_classes": [["none", "air_drag"]], "class": ["none", "air_drag"]}
    assert not marks(tmp_path, sealed(), "air_drag", **classes)["right"]  # nothing is no effect


def test_outside_and_pairs(tmp_path: Path) -> None:
    assert marks(tmp_path, sealed("vortex_field", outside=True), "unknown")["abstains"]
    sure = marks(tmp_path, sealed("vortex_field", outside=True), "gusts", probability=0.95)
    assert sure["confidently_wrong"]
    assert marks(tmp_path, sealed("gusts", "shading"), "shading")["pair_right"]
    assert not marks(tmp_path, sealed("gusts", "shading"), "air_drag")["pair_right"]


def test_stated_probabilities_add_up_over_a_class(tmp_path: Path) -> None:
    found = marks(
        tmp_path,
        sealed("gravity_tilt"),
        "wind",
        probabilities={"gravity_tilt": 0.3, "wind": 0.35, "air_drag": 0.35},
        equivalence_classes=[["gravity_tilt", "wind"]],
    )
    assert found["stated"] == pytest.approx(0.65)
    assert found["stated_right"]


def test_baselines_and_the_next_recording(tmp_path: Path) -> None:
    path = answered(
        tmp_path,
        "none",
        baselines={"method of single clips": {"effect": "air_drag"}},
        next_recording={"motion": "sway", "gain": 0.4},
    )
    answer = read_answer(path)
    assert answer.next_motion == "sway"
    assert answer.baselines == {"method of single clips": "air_drag", LOSS_DROP: "gusts"}
    path.write_text(path.read_text().replace('"baselines": {', '"baselines": {"other": {}, '))
    with pytest.raises(InputError, match="understood"):
        read_answer(path)


def test_no_answer_is_wrong() -> None:
    assert mark_session("s", sealed("gusts"), None, Path(), None)["right"] is False


def test_calibration_error() -> None:
    rng = np.random.default_rng(0)
    stated = rng.uniform(0, 1, 20000)
    right = (rng.uniform(0, 1, 20000) < stated).astype(float)
    assert calibration_error(stated, right) < 0.015
    assert calibration_error(np.full(10, 0.9), np.zeros(10)) == pytest.approx(0.9)


def table(tmp_path: Path) -> pd.DataFrame:
    rows = []
    for clips, names in (("3", ("air_drag", "none", "unknown")), ("1", ("none", "air_drag", "gusts"))):
        truths = (sealed("air_drag"), sealed(), sealed("vortex_field", outside=True))
        for truth, effect in zip(truths, names, strict=True):
            rows.append({"clips": clips, **marks(tmp_path, truth, effect)})
    return pd.DataFrame(rows)


def test_the_table_of_measures(tmp_path: Path) -> None:
    rows = table(tmp_path)
    found = measured_sessions(rows, resamplings=50, seed=0)
    assert list(found.columns) == ["measure", "generator", "clips", "value", "low", "high", "scenes"]
    at = found.set_index(["measure", "generator", "clips"])
    named = "named rightly, effects of 3 % and more"
    assert at.loc[(named, "all", "3"), "value"] == 1.0
    assert at.loc[(named, "toile", "1"), "value"] == 0.0
    assert at.loc[(f"{named} [{LOSS_DROP}]", "all", "3"), "value"] == 0.0
    assert at.loc[("false alarms on nulls", "all", "1"), "value"] == 1.0
    assert (at.loc[(named, "all", "3"), "low"], 1.0) == pytest.approx(wilson(1, 1))
    assert at.loc[("time, median [s]", "all", "3"), "value"] == 60.0
    again = measured_sessions(rows, resamplings=50, seed=0)
    pd.testing.assert_frame_equal(found, again)


def test_a_set_without_single_effects_has_an_empty_curve() -> None:
    rows = pd.DataFrame({"clips": ["3"], "generator": ["toile"], "kind": ["null"], "of_the_image": [False]})
    curve = by_size(rows)
    assert curve.empty
    assert {"generator", "scenes"} <= set(curve.columns)


def test_curves(tmp_path: Path) -> None:
    rows = table(tmp_path)
    curve = by_size(rows).set_index(["clips", "generator", "by", "low_edge"])
    assert curve.loc[("3", "all", "asked", 2.0), "value"] == 1.0
    assert curve.loc[("3", "all", "detection limit", 4.0), "scenes"] == 1
    assert math.isnan(curve.loc[("3", "all", "gap", 6.0), "value"])
    diagram = reliability(rows)
    assert set(diagram["clips"]) == {"1", "3"}
    assert int(diagram["scenes"].sum()) == 6


@pytest.mark.parametrize(("answer", "share"), [("air_drag", 1.0), ("gusts", 0.5), ("ambiguous", 0.0)])
def test_what_an_answer_saves_is_measured_by_the_true_effect(
    tmp_path: Path, answer: str, share: float
) -> None:
    shrinks = {"air_drag": shrunk(6.0), "gusts": shrunk(8.0)}
    found = marks(tmp_path, sealed("air_drag"), answer, shrinks=shrinks)
    assert found["shrink_true"] == pytest.approx(0.4)
    assert found["share_of_oracle"] == pytest.approx(share)
    assert found["placebo_of_true"] == pytest.approx(0.25)


def test_without_the_true_effect_there_is_no_share(tmp_path: Path) -> None:
    found = marks(tmp_path, sealed("contact"), "gusts", shrinks={"gusts": shrunk(8.0)})
    assert "share_of_oracle" not in found
    assert found["shrink_runner_up"] == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("truth", "wrong"),
    [
        (sealed(), {"false_alarm": True, "set_right": False}),
        (sealed("shrinking", outside=True), {"abstains": False, "confidently_wrong": True}),
    ],
)
def test_no_answer_is_wrong_in_everything(tmp_path: Path, truth: Sealed, wrong: dict[str, bool]) -> None:
    """It dropped out of the rates that it makes worse."""
    found = mark_session("s", truth, None, tmp_path, None)
    assert {name: found[name] for name in wrong} == wrong


def test_which_of_an_ambiguous_answer_is_most_probable_is_not_said(tmp_path: Path) -> None:
    """The probability of a verdict is that of its whole set."""
    found = marks(tmp_path, sealed("air_drag"), "ambiguous")
    assert "stated" not in found
    found = marks(tmp_path, sealed("air_drag"), "ambiguous", probabilities={"air_drag": 0.6, "none": 0.4})
    assert (found["stated"], found["stated_right"]) == (0.6, True)


def test_frames_of_a_clip_that_was_added_are_not_marked(tmp_path: Path) -> None:
    truth = sealed("air_drag")
    answer = read_answer(answered(tmp_path, "air_drag"))
    where = replace(answer.report.where, frames=(*answer.report.where.frames, 4.0, 4.0))
    longer = replace(answer, report=replace(answer.report, where=where))
    assert "frames_f1" in mark_session("s", truth, answer, tmp_path, 60.0)
    assert "frames_f1" not in mark_session("s", truth, longer, tmp_path, 60.0)
