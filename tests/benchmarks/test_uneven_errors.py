"""What the page says of errors that are found place by place."""

from __future__ import annotations

import importlib
from pathlib import Path

import pandas as pd
import pytest

ROOT = Path(__file__).parents[2]


def test_the_page_has_both_kinds_of_errors_of_every_session(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    program = importlib.import_module("uneven_errors")
    table = pd.read_csv(ROOT / program.TABLE)
    assert set(table["errors"]) == set(program.ERRORS)
    assert table.groupby("session")["errors"].nunique().eq(2).all()
    page = program.page(table)
    assert page == (ROOT / program.TABLE).with_suffix(".md").read_text()
    assert "nan" not in page


def test_a_null_has_no_cause_that_could_be_ahead(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    program = importlib.import_module("uneven_errors")
    rows = [
        ("air_drag_3_1", "uneven", 50.0, 20.0),
        ("air_drag_3_1", "alike", 40.0, 25.0),
        ("blender-none_0_301", "uneven", float("nan"), 5.0),
        ("blender-none_0_301", "alike", float("nan"), 12.0),
    ]
    table = pd.DataFrame(rows, columns=["session", "errors", "cause [nats]", "its nats"])
    by = program.over_rival(table)
    assert by.loc["air_drag_3_1", ["uneven", "alike"]].tolist() == [30.0, 15.0]
    assert by.loc["blender-none_0_301", ["uneven", "alike"]].tolist() == [5.0, 12.0]
    assert by["null"].tolist() == [False, True]
