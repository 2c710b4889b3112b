"""From hand-made labels and answers to the documents of a blind check."""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import imageio.v3 as iio
import numpy as np
import pandas as pd
import pytest

from toile.blind.grading import grade_set, write_grade
from toile.blind.run import Predictions, _of_earlier_attempts, write_predictions
from toile.blind.sealing import BlindSet, Sealed, SealKey
from toile.blind.tables import by_effect, by_generator, limits, over_naive
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
from toile.diagnosis.stage_times import StageTimes
from toile.effects.catalogue import STAGES
from toile.errors import InputError

BENCHMARKS = Path(__file__).parents[3] / "benchmarks"
FRAMES = np.zeros((4, 3, 3, 3), np.float32)

# name: effect, level, generator, answer
SCENES = {
    "a00001": ("", "", "toile", "none"),
    "a00002": ("", "", "toile", "gusts"),
    "a00003": ("", "", "blender", "none"),
    "a00004": ("air_drag", "weak", "toile", "none"),
    "a00005": ("air_drag", "medium", "toile", "air_drag"),
    "a00006": ("air_drag", "strong", "blender", "air_drag"),
    "a00007": ("frame_rate", "medium", "toile", "frame_rate"),
    "a00008": ("motion_blur", "medium", "blender", "motion_blur"),
    "a00009": ("gusts", "strong", "toile", "ambiguous"),
    "a00010": ("vortex_field", "strong", "toile", "unknown"),
    "a00011": ("air_drag+shading", "medium+medium", "toile", "air_drag"),
    "a00012": ("gusts", "medium", "toile", ""),
}


def label(effects: str, level: str, generator: str) -> dict[str, Any]:
    names = effects.split("+") if effects else []
    own = {"interval_ratio": 1.1} if effects == "frame_rate" else {}
    parameters: dict[str, Any] = {n: {} for n in names}
    if generator == "blender":
        parameters = {"shutter": 0.5} if effects == "motion_blur" else {}
    moves = [n for n in names if n != "motion_blur"]
    return {
        "effect": effects or "none",
        "effects": names,
        "levels": level.split("+") if level else [],
        "stage": STAGES[names[0]].value if names and names[0] in STAGES else "mechanics" if names else "none",
        "stage_accept": ["mechanics", "actuation", "appearance"] if names else ["none"],
        "in_catalogue": effects != "vortex_field",
        "generator": generator,
        "parameters": parameters,
        "comparable": {effects: own} if generator == "toile" else {},
        "magnitude": {
            "mean_last_third": 2.0 if moves else 0.0,
            "alone": {n: {"value": 2.0, "measure": "motion"} for n in moves},
        },
        "localisation": {"vertices": None, "frames": None},
    }


def answer(effect: str) -> GapReport:
    """Drag was compared on held-out frames, and the frame rate; gusts were not."""
    drag = Shrink("position [mm]", "frames 3 to 3", 10.0, 6.0, 0.4, 0.3, 0.5, 0.1)
    rate = Shrink("position [mm]", "frames 3 to 3", 10.0, 30.0, -2.0, -2.1, -1.9, 0.1)
    candidates = ("gusts", "none") if effect == "ambiguous" else (effect,)
    stage = STAGES[effect].value if effect in STAGES else "unknown" if effect != "none" else "none"
    return GapReport(
        Verdict(effect, candidates, stage, 0.8, "", ""),
        Where({}, (1.0,) * 4, None),
        (
            EffectReport("air_drag", "mechanics", 0.5, {}, drag),
            EffectReport(
                "frame_rate", "mechanics", 0.3, {"log_factor": Estimate(0.09, 0.05, 0.13, "1")}, rate
            ),
            EffectReport("motion_blur", "appearance", 0.1, {"fraction": Estimate(0.6, 0.55, 0.7, "1")}),
            EffectReport("gusts", "actuation", 0.1, {}),
        ),
        Alias(("air_drag", "gusts"), ((1.0, 0.3), (0.3, 1.0)), {"air_drag": 0.5, "gusts": None}),
        Protocol(0, (0, 1, 2), (3,), "test", "gusts"),
    )


def write_scene(folder: Path) -> None:
    for name in ("rgbs", "masks"):
        (folder / name).mkdir(parents=True)
    for frame in range(4):
        mask = np.zeros((8, 8), np.uint8)
        mask[2:6, 2:6] = 255
        iio.imwrite(folder / "rgbs" / f"rgb_{frame:03d}.png", np.stack((mask // 2,) * 3, -1))
        iio.imwrite(folder / "masks" / f"mask_{frame:03d}.png", mask)
    (folder / "template.obj").write_text("v 0 0 0")
    values = {"n_frames": 4, "grid": [3, 3], "fps": 25.0, "K": [[9.0, 0, 4]], "gravity": [0, 9.8, 0]}
    (folder / "scene.json").write_text(json.dumps(values))


@pytest.fixture
def graded(tmp_path: Path) -> tuple[BlindSet, Predictions, SealKey]:
    """A set of hand-made scenes with its grade."""
    key = SealKey.of_seed(3)
    blind, predictions = BlindSet(tmp_path / "blind" / "x"), Predictions(tmp_path / "predictions" / "x")
    blind.folder.mkdir(parents=True)
    description = {
        "composition": "standard",
        "blind": True,
        "out_of_family": {},
        "key": key.fingerprint,
        "notes": ["the first 12 of 60 scenes in the order of their names"],
        "scenes": list(SCENES),
    }
    blind.description.write_text(json.dumps(description))
    for name, (effects, level, generator, given) in SCENES.items():
        write_scene(blind.scenes / name)
        blind.seal(key, name, Sealed(label(effects, level, generator), FRAMES, FRAMES))
        if given:
            answer(given).write(predictions.diagnosis(name))
            times = StageTimes()
            for stage in ("tracking", "maps"):
                with times.stage(stage):
                    pass
            if name == "a00001":
                times.from_cache("tracking")
            times.write(predictions.diagnosis(name).with_name("times.json"))
    blind.commit(key, tuple(SCENES))
    write_predictions(blind, predictions, incomplete=True)
    write_grade(grade_set(blind, predictions, key, resamplings=20), predictions.grade)
    return blind, predictions, key


@pytest.fixture
def results(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The script as a module."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    for name in ("blind_results", "bench_diagnosis"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return importlib.import_module("blind_results")


def test_tables_by_effect_generator_and_against_the_baseline(
    graded: tuple[BlindSet, Predictions, SealKey], results: ModuleType
) -> None:
    marks = results.read_table(graded[1].grade / "scenes.csv")
    assert set(marks["kind"]) == {"null", "single", "outside", "pair"}
    drag = by_effect(marks).set_index("effect").loc["air_drag"]
    assert (drag["found"], drag["scenes"]) == (2, 3)
    assert (drag["weak"], drag["medium"], drag["strong"]) == ("0/1", "1/1", "1/1")
    assert drag["smallest_level"] == "medium"
    gusts = by_effect(marks).set_index("effect").loc["gusts"]
    assert (gusts["found"], gusts["in_set"], gusts["smallest_level"]) == (0, 1, "")
    assert gusts["naive"] == 1  # the other scene of gusts has no diagnosis
    measures = by_generator(marks, resamplings=5, seed=0).set_index(["generator", "measure"])
    assert measures.loc[("toile", "false alarms on nulls"), "value"] == 0.5
    assert measures.loc[("blender", "false alarms on nulls"), "value"] == 0.0
    singles = over_naive(marks, resamplings=50, seed=0).set_index("over").loc["singles"]
    assert singles["diagnosis"] == pytest.approx(4 / 7)
    assert singles["naive"] == pytest.approx(1 / 7)
    assert singles["low"] <= singles["difference"] <= singles["high"]


def test_limits_over_all_clips() -> None:
    first, second = answer("none"), answer("none")
    second.alias.detection_limits["air_drag"] = 1.5
    found = limits([first, second, None]).set_index("effect")
    assert found.loc["air_drag", "median"] == 1.0
    assert (found.loc["air_drag", "unit"], found.loc["air_drag", "parameter"]) == ("1/s", "linear")
    assert (found.loc["gusts", "with_limit"], found.loc["gusts", "clips"]) == (0, 2)


def test_shrink_of_moving_singles(graded: tuple[BlindSet, Predictions, SealKey], results: ModuleType) -> None:
    marks = results.read_table(graded[1].grade / "scenes.csv")
    moving = results.moving_singles(marks).set_index("scene")
    # Neither blur, which moves nothing, nor what has no diagnosis.
    assert set(moving.index) == {"a00004", "a00005", "a00006", "a00007", "a00009"}
    assert moving.loc["a00005", "shrink_true"] == pytest.approx(0.4)
    assert moving.loc["a00005", "runner_up"] == "frame_rate"
    assert moving.loc["a00007", "shrink_runner_up"] == pytest.approx(0.4)
    # Not compared: missing, with what stands beside it.
    assert np.isnan(moving.loc["a00009", "shrink_true"])
    assert moving.loc["a00009", "shrink_runner_up"] == pytest.approx(0.4)
    assert "other 1 it was not" in results.shrink_caption(moving)


def test_document(graded: tuple[BlindSet, Predictions, SealKey], results: ModuleType, tmp_path: Path) -> None:
    blind, predictions, _ = graded
    docs = tmp_path / "docs"
    (docs / "results").mkdir(parents=True)
    (docs / "diagnosis").mkdir()
    (docs / "diagnosis" / "validation.md").write_text("before\n<!-- blind -->\nold\n<!-- /blind -->\nafter\n")
    (docs / "results" / "benchmarks.md").write_text("# B\n\n## bench_fit\n\nx\n")
    results.write_results(blind, predictions, docs, permutations=20, draws=2)
    text = (docs / "results" / "blind_standard.md").read_text()
    for part in (
        "The first 12 of 60 scenes in the order of their names.",
        "1 of 12 scenes have no diagnosis",
        "| false alarms on nulls",
        "## Confusion matrix",
        "log_factor: 0.0953, 0.09 [0.05, 0.13]",
        "../images/blind_standard_shrink.png",
        "| a00010 ",
        "linear 0.5 1/s",
        "## Run times",
    ):
        assert part in text, part
    assert (docs / "images" / "blind_standard_shrink.png").stat().st_size > 1000
    measures = pd.read_csv(docs / "results" / "blind_standard.csv")
    assert set(measures["generator"]) == {"all", "toile", "blender"}
    times = pd.read_csv(docs / "results" / "blind_standard_times.csv")
    assert list(times["stage"].unique()) == ["tracking", "maps"]
    assert times["wall"].isna().sum() == 1
    benchmarks = (docs / "results" / "benchmarks.md").read_text()
    assert results.put_section(benchmarks, "bench_diagnosis", "y").count("## bench_diagnosis") == 1
    assert benchmarks.index("bench_diagnosis") < benchmarks.index("bench_fit")
    assert benchmarks.endswith("## bench_fit\n\nx\n")
    page = (docs / "diagnosis" / "validation.md").read_text()
    assert page.startswith("before\n")
    assert page.endswith("after\n")
    assert "old" not in page
    assert "| stage accuracy" in page


def test_another_set_beside_it(
    graded: tuple[BlindSet, Predictions, SealKey], results: ModuleType, tmp_path: Path
) -> None:
    blind, predictions, _ = graded
    docs = tmp_path / "docs"
    (docs / "results").mkdir(parents=True)
    (docs / "diagnosis").mkdir()
    page, times = docs / "diagnosis" / "validation.md", docs / "results" / "benchmarks.md"
    page.write_text("<!-- blind -->\nof one set\n<!-- /blind -->\n")
    times.write_text("## bench_diagnosis\n\nof one set\n")
    made = results.write_results(blind, predictions, docs, stem="before", permutations=20, draws=2)
    assert {path.name.removeprefix("before") for path in made} == {
        ".csv",
        "_scenes.csv",
        "_times.csv",
        "_shrink.png",
        ".md",
    }
    assert "../images/before_shrink.png" in (docs / "results" / "before.md").read_text()
    assert "of one set" in page.read_text()
    assert "of one set" in times.read_text()


def test_grade_of_other_predictions_is_refused(
    graded: tuple[BlindSet, Predictions, SealKey], results: ModuleType, tmp_path: Path
) -> None:
    blind, predictions, _ = graded
    predictions.hash.write_text("0" * 64 + "\n")
    with pytest.raises(InputError, match="other predictions"):
        results.write_results(blind, predictions, tmp_path / "docs")


def test_time_of_an_interrupted_attempt_counts(tmp_path: Path) -> None:
    """What it has made is read by the one after, which says how long it took."""
    assert _of_earlier_attempts(tmp_path) == 0.0
    stages = {"tracking": (12.5, True), "refined motion": (30.0, True), "answer": (7.0, False)}
    values = {name: {"wall": wall, "cpu": wall, "cached": cached} for name, (wall, cached) in stages.items()}
    values["lost"] = {"wall": None, "cpu": None, "cached": True}
    (tmp_path / "times.json").write_text(json.dumps({"stages": values}))
    assert _of_earlier_attempts(tmp_path) == 42.5
