"""What counts as usual evidence, from scenes whose effect is known."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from toile.blind import calibration
from toile.blind.calibration import CalibrationSettings, Case
from toile.diagnosis.arrays import SCREENING_FILE
from toile.diagnosis.decision import NONE, SHIPPED, UNKNOWN, Calibration, Weights, probabilities
from toile.diagnosis.made_with import MADE_WITH_FILE, MadeWith
from toile.diagnosis.settings import DiagnosisSettings
from toile.errors import InputError

SCENES = Path(__file__).parents[3] / "docs/results/calibration_scenes.csv"
WITH = MadeWith.of({"diagnosis": {"sides": [20], "weights": {"predictive": 20.0}, "seed": 0}})


def _nulls(drags: list[float]) -> list[Case]:
    return [
        Case(f"n{k}", NONE, {"air_drag": drag, "frame_rate": 0.0, UNKNOWN: 0.0})
        for k, drag in enumerate(drags)
    ]


def test_one_misleading_null_is_no_rule() -> None:
    one = calibration.calibrate(_nulls([40.0, 0.0, 0.0, 0.0]), "test")
    # Four scenes of zero are granted beside the four there are.
    assert one.usual["air_drag"] == pytest.approx(40 / 8)
    rule = calibration.calibrate(_nulls([40.0] * 12), "test")
    assert rule.usual["air_drag"] == pytest.approx(40 * 12 / 16)
    # A drag of the same evidence is hardly to be told from what is usual there, and easily here.
    evidence = {"air_drag": 75.0, "frame_rate": 0.0, UNKNOWN: 0.0}
    assert probabilities(evidence, one)["air_drag"] > probabilities(evidence, rule)["air_drag"]


def test_few_quiet_scenes_are_not_taken_for_certainty() -> None:
    found = calibration.calibrate(_nulls([0.0, 0.0, 0.0]), "test")
    # What moves the cloth deviates by two at least, however alike the scenes are.
    assert found.spread["air_drag"] == 2.0
    assert found.usual["air_drag"] == 0.0
    # Two scenes say nothing of what is usual for an effect.
    assert "air_drag" not in calibration.calibrate(_nulls([0.0, 0.0]), "test").usual


def test_a_scene_says_nothing_of_the_usual_where_its_effect_acts() -> None:
    moving = Case("m", "internal_damping", {"air_drag": 90.0, "shading": 0.0, UNKNOWN: 0.0})
    lit = Case("s", "shading", {"air_drag": 90.0, "shading": 50.0, UNKNOWN: 0.0})
    assert not calibration.is_quiet(moving, "air_drag")
    assert calibration.is_quiet(moving, "shading")
    assert calibration.is_quiet(lit, "air_drag")
    outside = Case("v", UNKNOWN, {"air_drag": 90.0, UNKNOWN: 50.0})
    assert not calibration.is_quiet(outside, "air_drag")
    found = calibration.calibrate([*_nulls([0.0, 0.0, 0.0]), moving, outside], "test")
    assert found.usual["air_drag"] == 0.0


def test_a_scene_that_is_left_out_does_not_answer_for_itself() -> None:
    loud = {"air_drag": 0.0, "frame_rate": 90.0, UNKNOWN: 0.0}
    odd = Case("odd", NONE, loud)
    quiet = [*_nulls([0.0] * 6), Case("f", "frame_rate", loud)]
    with_itself = calibration.verdict_by(loud, calibration.calibrate([*quiet, odd, odd, odd, odd], "test"))
    verdicts, _ = calibration.left_out([*quiet, odd])
    without = verdicts[-1]
    assert without.effect == "frame_rate"
    assert with_itself.effect != "frame_rate"
    text = calibration.summary([odd], [without])
    assert "none: 0 of 1 right, 0 in the 90 % set of 1.0 on average, 1 named wrongly" in text


def test_the_shipped_calibration_comes_from_the_committed_scenes() -> None:
    shipped = Calibration.load()
    assert shipped.made_with is not None
    cases = calibration.cases_of(
        calibration.read_table(SCENES, shipped.made_with), Weights(), DiagnosisSettings().usual_cost
    )
    found = calibration.calibrate(cases, shipped.source, made_with=shipped.made_with)
    assert (found.temperature, found.threshold, found.unknown) == (
        shipped.temperature,
        shipped.threshold,
        shipped.unknown,
    )
    assert found.usual == pytest.approx(shipped.usual, abs=2e-3)
    assert found.spread == pytest.approx(shipped.spread, abs=2e-3)
    # To the last digit of the file.
    assert found.to_json() == SHIPPED.read_text()


def test_few_points_of_a_grid_are_all_tried() -> None:
    loud = {"air_drag": 30.0, "frame_rate": 0.0, UNKNOWN: 0.0}
    cases = [*_nulls([0.0, 0.0, 0.0, 9.0]), Case("d", "air_drag", loud), Case("n", NONE, loud)]
    settings = CalibrationSettings(temperatures=(0.5, 2.0), thresholds=(1.0, 8.0), unknowns=(3.0,))
    found = calibration.calibrate(cases, "test", settings=settings)

    def score(temperature: float, threshold: float) -> float:
        tried = replace(found, temperature=temperature, threshold=threshold)
        chances = [probabilities(case.evidence, tried)[case.truth] for case in cases]
        return float(np.log(np.array(chances) + settings.floor).sum())

    tried = [(t, a) for t in settings.temperatures for a in settings.thresholds]
    assert (found.temperature, found.threshold) == max(tried, key=lambda at: score(*at))
    assert found.unknown == 3.0


def test_settings_of_the_making_count() -> None:
    cases = _nulls([40.0, 0.0, 0.0, 0.0])
    granted = calibration.calibrate(cases, "test", settings=CalibrationSettings(granted=12.0))
    assert granted.usual["air_drag"] == pytest.approx(40 / 16)
    wide = calibration.calibrate(_nulls([0.0] * 3), "test", settings=CalibrationSettings(least_moving=3.0))
    assert wide.spread["air_drag"] == 3.0
    few = calibration.calibrate(_nulls([0.0] * 3), "test", settings=CalibrationSettings(fewest=4))
    assert "air_drag" not in few.usual


def test_scenes_that_all_have_an_effect_on_the_motion_say_nothing_of_the_usual() -> None:
    case = Case("d", "air_drag", {"air_drag": 30.0, UNKNOWN: 0.0})
    with pytest.raises(InputError, match="usual_from"):
        calibration.calibrate([case], "test")
    before = Calibration({UNKNOWN: 1.0}, {UNKNOWN: 2.0}, 1.0, 4.0, 6.0, "before")
    assert calibration.calibrate([case], "test", before).usual == before.usual


def run_of(folder: Path, made_with: MadeWith, drag: float = 0.0) -> Path:
    """What a diagnosis leaves of what it has measured."""
    folder.mkdir()
    np.savez(
        folder / SCREENING_FILE,
        names=np.array(["air_drag", "shading"]),
        in_sample=np.array([drag, -2.0]),
        prediction_gain=np.array([0.1, np.nan]),
        size=np.array([0.02, np.nan]),
        unknown=np.array(1.0),
        left=np.array(3.0),
        time_step_error=np.array(0.001),
        width=np.array(0.5),
    )
    made_with.write(folder / MADE_WITH_FILE)
    return folder


def test_runs_become_a_table_and_a_table_the_same_scenes(tmp_path: Path) -> None:
    runs = [run_of(tmp_path / name, WITH, drag) for name, drag in (("a", 0.0), ("b", 40.0), ("v", 3.0))]
    labels = {"a": NONE, "b": "air_drag", "v": "vortex", "elsewhere": NONE}
    table = calibration.read_runs(runs, labels, WITH)
    cases = calibration.cases_of(table, Weights(in_sample=0.5, predictive=20.0), 15.0)
    assert [case.truth for case in cases] == [NONE, "air_drag", UNKNOWN]
    assert cases[1].evidence == pytest.approx(
        {"air_drag": 0.5 * 40 + 20 * 0.1, "shading": -2.0, UNKNOWN: 0.5}
    )
    path = calibration.write_table(tmp_path / "scenes.csv", table)
    pd.testing.assert_frame_equal(calibration.read_table(path, WITH), table)


def test_runs_of_other_settings_are_refused(tmp_path: Path) -> None:
    """But for what evidence counts for, which is applied to what was measured."""
    run = run_of(tmp_path / "a", WITH)
    weighed = MadeWith.of({"diagnosis": {"sides": [20], "weights": {"predictive": 40.0}}})
    table = calibration.read_runs([run], {"a": NONE}, weighed)
    coarse = MadeWith.of({"diagnosis": {"sides": [14], "weights": {"predictive": 20.0}}})
    with pytest.raises(InputError, match=r"diagnosis.sides: \[20\], asked for: \[14\]"):
        calibration.read_runs([run], {"a": NONE}, coarse)
    path = calibration.write_table(tmp_path / "scenes.csv", table)
    calibration.read_table(path, weighed)
    with pytest.raises(InputError, match="other settings"):
        calibration.read_table(path, coarse)
    (run / MADE_WITH_FILE).unlink()
    with pytest.raises(InputError, match=MADE_WITH_FILE):
        calibration.read_runs([run], {"a": NONE}, WITH)


@pytest.mark.parametrize("text", ["", "scene,truth\n", "[1]"])
def test_what_is_no_table_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "scenes.csv"
    path.write_text(text)
    with pytest.raises(InputError, match="No measured scenes"):
        calibration.read_table(path, WITH)


def test_a_run_without_label_or_measurements_is_refused(tmp_path: Path) -> None:
    run = run_of(tmp_path / "a", WITH)
    with pytest.raises(InputError, match="no label"):
        calibration.read_runs([run], {"b": NONE}, WITH)
    (run / SCREENING_FILE).unlink()
    with pytest.raises(InputError, match="no measured evidence"):
        calibration.read_runs([run], {"a": NONE}, WITH)
    for wrong in ("no JSON", "[1]", '{"a": 1}'):
        (tmp_path / "labels.json").write_text(wrong)
        with pytest.raises(InputError, match="Labels cannot be read"):
            calibration.read_labels(tmp_path / "labels.json")


def test_a_calibration_is_read_as_it_was_written(tmp_path: Path) -> None:
    path = tmp_path / "calibration.json"
    made = Calibration({"air_drag": 0.5}, {"air_drag": 2.0}, 1.0, 4.0, 6.0, "tést", WITH)
    path.write_text(made.to_json())
    assert Calibration.load(path) == made
    path.write_text(replace(made, made_with=None).to_json())
    assert Calibration.load(path).made_with is None


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("temperature", 0.0, "temperature"),
        ("usual", {"air_drag": "much"}, "usual.air_drag"),
        ("threshhold", 4.0, "threshhold"),
        ("settings_digest", "0123456789ab", "other settings"),
    ],
)
def test_a_wrong_calibration_is_named(tmp_path: Path, key: str, value: object, message: str) -> None:
    path = tmp_path / "calibration.json"
    values = json.loads(Calibration({}, {}, 1.0, 4.0, 6.0, "test", WITH).to_json())
    path.write_text(json.dumps({**values, key: value}))
    with pytest.raises(InputError, match=message):
        Calibration.load(path)
    with pytest.raises(InputError, match="FileNotFoundError"):
        Calibration.load(tmp_path / "none.json")


def test_a_calibration_belongs_to_its_settings() -> None:
    made = Calibration({}, {}, 1.0, 4.0, 6.0, "test", WITH)
    seeded = MadeWith.of({"diagnosis": {"sides": (20.0,), "weights": {"predictive": 20}, "seed": 7}})
    use = made.use(seeded)
    assert use.calibrated
    assert use.differences == ()
    assert use.settings == use.made_for == WITH.digest
    other = made.use(MadeWith.of({"diagnosis": {"sides": [20], "weights": None}}), Path("mine.json"))
    assert not other.calibrated
    assert other.differences == ("diagnosis.weights: null, calibrated with given",)
    assert other.file == "mine.json"
    assert other.settings != other.made_for
    # What nobody knows is not calibrated.
    assert not made.use(None).calibrated
    assert not replace(made, made_with=None).use(WITH).calibrated
