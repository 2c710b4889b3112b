"""Contact beside free forces with either push."""

from __future__ import annotations

import importlib
from pathlib import Path

import pandas as pd
import pytest
import torch

from toile.effects.contact import Contact
from toile.effects.gusts import Gusts
from toile.effects.obstacles import Sphere

ROOT = Path(__file__).parents[2]


def test_the_page_has_both_pushes_of_every_session(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    program = importlib.import_module("contact_push")
    table = pd.read_csv(ROOT / program.TABLE)
    assert set(table["push"]) == set(program.FORMS)
    assert table.groupby("session")["push"].nunique().eq(2).all()
    # Under the law contact is the same.
    assert table.groupby("session")["contact [nats]"].nunique(dropna=False).eq(1).all()
    table.loc[0, ["revision", "contact [nats]"]] = ["0123456789abcdef", float("nan")]
    page = program.page(table)
    assert "at 0123456" in page
    lines = [line for line in page.splitlines() if line.startswith("| ")]
    assert len(lines) == len(table) + 1
    assert "nan" not in page
    assert "–" in lines[1]


def test_without_a_history_it_is_the_contact_that_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    program = importlib.import_module("contact_push")
    contact, gusts = Contact(Sphere([0.0, 0.1, 1.0], 0.2), thickness=0.01), Gusts()
    same = program.unvarying(contact)
    assert same.pushing(1.0) is same
    assert {k: v.tolist() for k, v in same.place().items()} == {
        k: v.tolist() for k, v in contact.place().items()
    }
    assert program.unvarying(gusts) is gusts
    at = torch.tensor([[0.0, 0.1, 0.795]], dtype=torch.float64)
    assert float(same.depth(at, at)) == pytest.approx(0.005)
