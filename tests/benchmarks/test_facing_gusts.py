"""The same clip with gusts of either form."""

from __future__ import annotations

import importlib
from pathlib import Path

import pandas as pd
import pytest

ROOT = Path(__file__).parents[2]


def test_the_page_says_what_made_it_and_what_has_no_share(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    program = importlib.import_module("facing_gusts")
    table = pd.read_csv(ROOT / program.TABLE)
    assert set(table["gusts push"]) == set(program.FORMS)
    assert table.groupby("session")["gusts push"].nunique().eq(2).all()
    table.loc[0, "revision"] = "0123456789abcdef"
    page = program.page(table)
    assert "at 0123456, " in page
    lines = [line for line in page.splitlines() if line.startswith("| ")]
    assert len(lines) == len(table) + 1
    assert "nan" not in page
    assert all(("–" in line) == ("alike" in line) for line in lines[1:])
