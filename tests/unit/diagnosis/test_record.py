"""diagnosis.json: written and read back, and refused where it is wrong."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from toile.diagnosis.record import (
    FORMAT,
    Alias,
    CalibrationUse,
    EffectReport,
    Estimate,
    GapReport,
    Protocol,
    Shrink,
    Verdict,
    Where,
)
from toile.errors import InputError


def report() -> GapReport:
    return GapReport(
        verdict=Verdict("gusts", ("gusts", "air_drag"), "actuation", 0.8, "pushed in turns", ""),
        where=Where(
            {"actuation": 0.7, "mechanics": 0.3}, (0.5, 2.5), "vertices.npy", {"slack": 1.0}, "acts.npy"
        ),
        effects=(
            EffectReport(
                "gusts",
                "actuation",
                0.8,
                {"deviation": Estimate(1.0, 0.5, 2.0, "m/s²")},
                Shrink("position [mm]", "frames 30 to 39", 10.0, 4.0, 0.6, 0.5, 0.7, 0.1),
            ),
            EffectReport("air_drag", "mechanics", 0.1),
        ),
        alias=Alias(("gusts", "air_drag"), ((1.0, 0.2), (0.2, 1.0)), {"gusts": 0.1, "air_drag": None}),
        protocol=Protocol(1, (0, 1), (2,), "0.1", "air_drag"),
        calibration=CalibrationUse(False, "mine.json", "0a1", "2b3", ("diagnosis.sides: 14",)),
        warnings=("The focal length is guessed",),
    )


def test_round_trip(tmp_path: Path) -> None:
    path = report().write(tmp_path / "diagnosis.json")
    assert GapReport.read(path) == report()


def test_files_of_before_do_not_say_whether_they_are_calibrated() -> None:
    values = report().to_json()
    del values["calibration"]
    assert GapReport.from_json(values).calibration is None


def test_files_of_before_do_not_say_where_an_effect_acts() -> None:
    values = report().to_json()
    del values["where"]["acts_on"]
    assert GapReport.from_json(values).where.acts_on is None


def test_files_of_before_have_no_warnings() -> None:
    values = report().to_json()
    del values["warnings"]
    assert GapReport.from_json(values).warnings == ()
    with pytest.raises(InputError, match="warnings"):
        GapReport.from_json({**values, "warnings": [1]})


def test_the_first_format_is_read() -> None:
    """It had two more keys, which never held a number; in the second one they are mistakes."""
    values = report().to_json()
    assert values.pop("format") == FORMAT
    values["effects"][0]["gap"] = None
    values["effects"][0]["shrink"]["oracle"] = None
    assert GapReport.from_json(values) == report()
    with pytest.raises(InputError, match=r"gap|oracle"):
        GapReport.from_json({**values, "format": FORMAT})
    with pytest.raises(InputError, match="format"):
        GapReport.from_json({**report().to_json(), "format": FORMAT + 1})


@pytest.mark.parametrize("path", sorted(Path(__file__).parents[3].glob("docs/results/**/*.json")), ids=str)
def test_committed_answers_are_read(path: Path) -> None:
    values = json.loads(path.read_text())
    if "verdict" not in values:
        pytest.skip("no diagnosis")
    assert GapReport.from_json(values).verdict.effect == values["verdict"]["effect"]


def test_effects_are_sorted() -> None:
    original = report()
    turned = GapReport(
        original.verdict, original.where, original.effects[::-1], original.alias, original.protocol
    )
    assert [e["name"] for e in turned.to_json()["effects"]] == ["gusts", "air_drag"]


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (("verdict", "probability"), 1.2, "probability"),
        (("verdict", "effect"), None, "string"),
        (("where", "frames"), [float("nan")], "finite"),
        (("alias", "matrix"), [[1.0]], "rows"),
        (("protocol", "seed"), 1.5, "integer"),
        (("calibration", "calibrated"), "no", "boolean"),
        (("calibration", "differences"), "all", "array"),
        (("verdict", "efect"), "gusts", "efect"),
        (("effects", 0, "parameters", "deviation", "low"), 1.5, "between"),
    ],
)
def test_mistakes_are_named(path, value, message) -> None:
    values = report().to_json()
    part = values
    for key in path[:-1]:
        part = part[key]
    part[path[-1]] = value
    with pytest.raises(InputError, match=message):
        GapReport.from_json(values)


def test_missing_key() -> None:
    values = report().to_json()
    del values["verdict"]["candidates"]
    with pytest.raises(InputError, match="candidates"):
        GapReport.from_json(values)


def test_no_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="diagnosis"):
        GapReport.read(tmp_path / "diagnosis.json")


def test_alias_classes_are_connected() -> None:
    matrix = ((1.0, 0.95, 0.1), (0.95, 1.0, 0.92), (0.1, 0.92, 1.0))
    alias = Alias(("a", "b", "c"), matrix)
    assert alias.classes(0.9) == (("a", "b", "c"),)
    assert alias.classes(0.94) == (("a", "b"), ("c",))
