"""From when on a cloth that seems to become smaller does is learnt from sessions with open labels."""

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
    return importlib.import_module("apparent_size")


def sessions(resting: float, shrinking: float, n: int = 12) -> pd.DataFrame:
    """As many that rest as that shrink, their sizes scattered by a factor of two."""
    rng = np.random.default_rng(2)
    factors = 2.0 ** rng.uniform(-1, 1, 2 * n)
    causes = ["none"] * n + ["shrinking"] * n
    changes = factors * np.repeat([resting, -shrinking], n)
    return pd.DataFrame({"session": range(2 * n), "cause": causes, "change of size [%]": changes})


def test_the_two_kinds_are_parted_between_their_sizes(program: ModuleType) -> None:
    weights = program.learnt(sessions(0.3, 5.0))
    assert 0.006 < weights.resized < 0.04
    assert program.chance(-8.0, weights) > 0.98
    assert program.chance(0.3, weights) < 0.01


def test_larger_errors_of_tracking_ask_for_more(program: ModuleType) -> None:
    careful, careless = (program.learnt(sessions(size, 6.0)) for size in (0.1, 1.5))
    assert careless.resized > careful.resized


def test_what_is_rare_needs_more_than_where_it_is_half(
    program: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    rare = program.learnt(sessions(0.3, 3.0))
    monkeypatch.setattr(program, "SHARE", 0.5)
    half = program.learnt(sessions(0.3, 3.0))
    assert rare.resizing == half.resizing
    # Odds of one to nineteen where they are even in the table.
    assert program.chance(100 * half.resized, rare) == pytest.approx(0.05, rel=1e-3)


def test_a_session_that_is_measured_again_counts_once(program: ModuleType) -> None:
    table = sessions(0.3, 5.0)
    again = table.iloc[[3]].assign(**{"change of size [%]": 0.7})
    both = program.added(table, again)
    assert len(both) == len(table)
    assert both.index.is_unique
    assert both.set_index("session").loc[3, "change of size [%]"] == 0.7
    assert len(program.added(pd.DataFrame(), again)) == 1


def test_the_package_has_what_the_table_says(program: ModuleType) -> None:
    table = pd.read_csv(ROOT / "docs" / "results" / "apparent_size.csv")
    learnt = program.learnt(table[table["engine"] != program.NEVER_LEARNT_FROM])
    shipped = SessionWeights.load()
    assert (shipped.resized, shipped.resizing) == pytest.approx((learnt.resized, learnt.resizing), rel=1e-6)
