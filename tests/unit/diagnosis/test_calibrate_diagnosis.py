"""What counts as usual evidence, from scenes whose effect is known."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from types import ModuleType

import pandas as pd
import pytest

from toile.diagnosis.decision import NONE, UNKNOWN, Calibration, probabilities

BENCHMARKS = Path(__file__).parents[3] / "benchmarks"


@pytest.fixture(scope="module")
def calibrate_diagnosis() -> ModuleType:
    """benchmarks/calibrate_diagnosis.py."""
    sys.path.insert(0, str(BENCHMARKS))
    try:
        return importlib.import_module("calibrate_diagnosis")
    finally:
        sys.path.remove(str(BENCHMARKS))


def _nulls(module: ModuleType, drags: list[float]) -> list[object]:
    return [
        module.Case(f"n{k}", NONE, {"air_drag": drag, "frame_rate": 0.0, UNKNOWN: 0.0})
        for k, drag in enumerate(drags)
    ]


def test_one_misleading_null_is_no_rule(calibrate_diagnosis: ModuleType) -> None:
    module = calibrate_diagnosis
    one = module.calibrate(_nulls(module, [40.0, 0.0, 0.0, 0.0]), "test")
    # Four scenes of zero are granted beside the four there are.
    assert one.usual["air_drag"] == pytest.approx(40 / 8)
    rule = module.calibrate(_nulls(module, [40.0] * 12), "test")
    assert rule.usual["air_drag"] == pytest.approx(40 * 12 / 16)
    # A drag of the same evidence is hardly to be told from what is usual there, and easily here.
    evidence = {"air_drag": 75.0, "frame_rate": 0.0, UNKNOWN: 0.0}
    assert probabilities(evidence, one)["air_drag"] > probabilities(evidence, rule)["air_drag"]


def test_few_quiet_scenes_are_not_taken_for_certainty(calibrate_diagnosis: ModuleType) -> None:
    module = calibrate_diagnosis
    found = module.calibrate(_nulls(module, [0.0, 0.0, 0.0]), "test")
    # What moves the cloth deviates by two at least, however alike the scenes are.
    assert found.spread["air_drag"] == 2.0
    assert found.usual["air_drag"] == 0.0
    # Two scenes say nothing of what is usual for an effect.
    assert "air_drag" not in module.calibrate(_nulls(module, [0.0, 0.0]), "test").usual


def test_a_scene_says_nothing_of_the_usual_where_its_effect_acts(calibrate_diagnosis: ModuleType) -> None:
    module = calibrate_diagnosis
    moving = module.Case("m", "internal_damping", {"air_drag": 90.0, "shading": 0.0, UNKNOWN: 0.0})
    lit = module.Case("s", "shading", {"air_drag": 90.0, "shading": 50.0, UNKNOWN: 0.0})
    assert not module.is_quiet(moving, "air_drag")
    assert module.is_quiet(moving, "shading")
    assert module.is_quiet(lit, "air_drag")
    outside = module.Case("v", UNKNOWN, {"air_drag": 90.0, UNKNOWN: 50.0})
    assert not module.is_quiet(outside, "air_drag")
    found = module.calibrate([*_nulls(module, [0.0, 0.0, 0.0]), moving, outside], "test")
    assert found.usual["air_drag"] == 0.0


def test_a_scene_that_is_left_out_does_not_answer_for_itself(calibrate_diagnosis: ModuleType) -> None:
    module = calibrate_diagnosis
    loud = {"air_drag": 0.0, "frame_rate": 90.0, UNKNOWN: 0.0}
    odd = module.Case("odd", NONE, loud)
    quiet = [*_nulls(module, [0.0] * 6), module.Case("f", "frame_rate", loud)]
    with_itself = module.verdict_by(loud, module.calibrate([*quiet, odd, odd, odd, odd], "test"))
    verdicts, _ = module.left_out([*quiet, odd])
    without = verdicts[-1]
    assert without.effect == "frame_rate"
    assert with_itself.effect != "frame_rate"
    text = module.summary([odd], [without])
    assert "none: 0 of 1 right, 0 in the 90 % set of 1.0 on average, 1 named wrongly" in text


def test_the_shipped_calibration_comes_from_the_committed_scenes(calibrate_diagnosis: ModuleType) -> None:
    module = calibrate_diagnosis
    cases = module.cases_of(pd.read_csv(module.SCENES, keep_default_na=False, na_values=[""]))
    shipped = Calibration.load()
    found = module.calibrate(cases, shipped.source)
    assert (found.temperature, found.threshold, found.unknown) == (
        shipped.temperature,
        shipped.threshold,
        shipped.unknown,
    )
    assert found.usual == pytest.approx(shipped.usual, abs=2e-3)
    assert found.spread == pytest.approx(shipped.spread, abs=2e-3)
