"""When something passes before a cloth is learnt from sessions with open labels."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType

import numpy as np
import pandas as pd
import pytest

from toile.diagnosis.session_weights import SessionWeights

ROOT = Path(__file__).parents[2]


@pytest.fixture
def program(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The benchmark, which imports others beside it."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    return importlib.import_module("occlusion")


def sessions(clear: float, covered: float, n: int = 12) -> pd.DataFrame:
    """As many that are clear as that are covered, what is hidden scattered by a factor of two."""
    factors = 2.0 ** np.random.default_rng(2).uniform(-1, 1, 2 * n)
    hidden = factors * np.repeat([clear, covered], n)
    causes = ["none"] * n + ["unmasked_occluder"] * n
    return pd.DataFrame({"session": range(2 * n), "cause": causes, "hidden [%]": hidden})


def test_the_two_kinds_are_parted_between_what_they_hide(program: ModuleType) -> None:
    weights = program.learnt(sessions(0.05, 5.0))
    assert 0.0005 < weights.covered < 0.05
    assert program.chance(6.0, weights) > 0.98
    assert program.chance(0.0, weights) < 0.01


def test_prints_that_are_lost_without_a_cause_ask_for_more(program: ModuleType) -> None:
    careful, careless = (program.learnt(sessions(clear, 6.0)) for clear in (0.01, 2.0))
    assert careless.covered > 1.5 * careful.covered


def test_the_package_has_what_the_table_says(program: ModuleType) -> None:
    table = pd.read_csv(ROOT / "docs" / "results" / "occlusion.csv", keep_default_na=False)
    learnt = program.learnt(table[table["engine"] != program.NEVER_LEARNT_FROM])
    shipped = SessionWeights.load()
    for name in ("covered", "covering"):
        assert getattr(shipped, name) == pytest.approx(getattr(learnt, name), rel=1e-6)
